"""Internal foundations of the package: checks, linear algebra, compilation, files, schemas."""
