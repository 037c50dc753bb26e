"""Fixtures: every device present, and the folder of real data where there is one."""

import os
import pathlib

import pytest
import warp as wp

wp.config.quiet = True
wp.init()


@pytest.fixture(params=["cpu", "cuda:0"] if wp.is_cuda_available() else ["cpu"])
def device(request):
    return request.param


@pytest.fixture
def real_data():
    """Folder that holds lego_800 and the like; the test is skipped without it."""
    folder = pathlib.Path(os.environ.get("WARPCAGE_DATA", "../shared/data"))
    if not (folder / "lego_800" / "transforms_train.json").is_file():
        pytest.skip(f"no data in {folder} (set WARPCAGE_DATA)")
    return folder
