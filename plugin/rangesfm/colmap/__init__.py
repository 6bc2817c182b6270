"""COLMAP models on disk and in memory, its options and its log."""
