"""EPnP: control points, their depths, and the solver."""

from kornia_pnpnet.init.epnp.epnp import EPnP

__all__ = ["EPnP"]
