"""Camera poses from 2D-3D correspondences with outliers, as a batched, differentiable PyTorch layer."""

import lazy_loader

__version__ = "0.1.0"

# The names are in __init__.pyi. PyTorch is imported at the first use of one of them, so that `pnpnet` answers --help
# and says that a file is missing at once.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]
