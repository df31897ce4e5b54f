"""EPnP: the initialiser (``epnp``), its control points and the equations of their depths (``depths``)."""

from kornia_pnpnet.init.epnp.epnp import EPnP

__all__ = ["EPnP"]
