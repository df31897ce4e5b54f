"""Initialisers propose the poses from which refinement starts.

A new one is a new file here: a subclass of :class:`~kornia_pnpnet.propose.initialiser.Initialiser`, which documents
what a solver must know of it.
"""
