"""Many surveys at once on Dask: which there are, what each may use, who works on them, what became of them."""
