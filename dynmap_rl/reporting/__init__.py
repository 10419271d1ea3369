"""Pages, figures and animations of runs and datasets."""
