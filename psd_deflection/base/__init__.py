"""What every room needs: arithmetic, errors, files, foreign YAML, tables, pages, sequence numbers."""
