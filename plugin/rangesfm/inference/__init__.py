"""The linear Gaussian problem of all measurements: noise, posterior, tests; no kind of measurement is known here."""
