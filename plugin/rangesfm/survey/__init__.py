"""Settings and inputs of a run."""
