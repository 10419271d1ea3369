"""Our environments, data and models in the tools of others."""
