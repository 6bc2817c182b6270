"""Safe reading and writing: tables, JSON, outputs that appear whole, one writer a folder."""
