"""Internal foundations of the package, not public: checks, linear algebra, compilation, files, schemas."""
