"""Safe reading and writing of files: tables, JSON, outputs that appear only when complete, one writer per folder."""
