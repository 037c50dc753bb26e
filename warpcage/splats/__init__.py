"""Gaussian splats: fields of them, their files, their views, and how a cage poses them."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "binding": "CageBinding PIECE PoseFit fit_similarity pieces_of sh_basis split_tree turned_harmonics",
        "clean": "clean_splats",
        "fit": "SplatGradients SplatParameters",
        "io": "WRITERS is_splat_file",
        "io.axes": "turned_over",
        "io.contents": "rotation_matrices SplatContents",
        "io.formats": "SplatFormat splat_formats",
        "render": "IMAGE_BLUR SplatRenderer splat_lens",
        "matter": "SplatDensity",
        "splat_field": "field_size load_field",
    },
)
