"""Voxel radiance fields: what they hold, how they render, what lies behind them."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "io": "load_field",
        "io.field_file": "surface_node_count",
        "render": "STOP_TRANSMITTANCE",
        "sparse": "DensityWatch harmonics_on_device harmonics_on_host spread_along",
        "surface": "extract_mesh surface_density",
        "surroundings": "LayeredBackground OuterField",
        "tables": "ColumnTable PACKED_UINT32S row_table shaded_grid",
    },
)
