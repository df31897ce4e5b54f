"""Initialisers: from normalised correspondences to a first guess of the pose."""

from kornia_pnpnet.init.mlp import MLPInit

__all__ = ["MLPInit"]
