"""The demo survey: photos that ship with the package, and simulated sensors."""
