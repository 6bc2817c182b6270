"""What ranges get wrong."""
