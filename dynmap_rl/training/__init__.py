"""Training of world models, policies and experts: loops and their typed settings."""
