"""Initialisers propose the poses from which refinement starts.

To add an initialiser, add a file with a subclass of :class:`~kornia_pnpnet.propose.initialiser.Initialiser` to this
package. The attributes of the subclass tell a solver what the initialiser can do.
"""
