"""Internal modules (not public): checks, linear algebra, compilation, files, schemas."""
