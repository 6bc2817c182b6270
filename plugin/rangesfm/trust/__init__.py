"""How far to trust what was given and what was found: each mistake said, with its size and what to do."""
