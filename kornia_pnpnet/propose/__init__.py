"""Initialisers propose the poses from which refinement starts.

A new initialiser is a new file in this package with a subclass of
:class:`~kornia_pnpnet.propose.initialiser.Initialiser`. The attributes of this class tell a solver what the initialiser
can do.
"""
