"""Camera poses from 2D-3D correspondences with outliers, as a batched, differentiable PyTorch layer."""

import lazy_loader

__version__ = "0.2.0"

# Public names (see __init__.pyi) are imported at their first use. The command `pnpnet` can therefore print its help, or
# report a missing file, without waiting for the import of PyTorch.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]
