"""The stages that estimate a map, each one code for all kinds of measurement."""
