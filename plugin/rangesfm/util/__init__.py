"""What is not about surveys: numbers and geometry, files, processes."""
