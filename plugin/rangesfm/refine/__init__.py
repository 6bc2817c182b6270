"""The refinement: bundle adjustment with ranges."""
