"""Voxel radiance fields: what they hold, how they render, what lies behind them."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "clean": "CleanOptions Cleaned clean_voxels",
        "io": "load_field",
        "io.field_file": "surface_node_count",
        "objects": "pick_point",
        "planes": "Plane blocks find_planes fit_planes surface_points surrounds",
        "render": "STOP_TRANSMITTANCE",
        "selection": "some_visible_nodes visible_nodes",
        "sparse": "DensityWatch harmonics_on_device harmonics_on_host spread_along",
        "surface": "extract_mesh surface_density",
        "surroundings": "LayeredBackground OuterField",
        "tables": "ColumnTable PACKED_WORDS row_table shaded_grid",
    },
)
