"""Specs: what a picture, a film and a fit are, each option described once for files, flags, the page and docs."""

from ...package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {"film": "FilmSpec", "scene": "FitSceneSpec FitSpec SceneSpec", "settings": "Settings", "shot": "ShotSpec"},
)
