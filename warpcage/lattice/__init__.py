"""Maps on the nodes of a lattice over a cage, new for each pose."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "closed_form": "GreenSolver VertexWeightSolver",
        "graph": "PoseGraph",
        "harmonic": "HarmonicSolver",
        "lattice": "BLOCK_FACES CageLattice LINE_CAPACITY",
        "launches": "PoseLaunches",
        "nodes": "continue_to_rings",
        "position_map": "fit_affine",
        "sizes": "NodeSections",
    },
)
