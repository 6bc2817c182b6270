"""Many surveys at once on Dask: their list, the resources of each, the workers, and the results."""
