"""EPnP: ``epnp`` has the initialiser, ``control_points`` the control points, ``depths`` the equations of depths."""

from kornia_pnpnet.propose.epnp.epnp import EPnP

__all__ = ["EPnP"]
