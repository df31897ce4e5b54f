"""What the rest of the package stands on and no user sees: checks, linear algebra, compilation, files, schemas."""
