"""Arguments of `warpcage info`, `demo`, `doctor` and `kernels`."""

from __future__ import annotations

import argparse

from .options import FRAME, FRAME_VALUE, SCALE_AND_DEVICE, add_rows, command

#: Most pictures on a contact sheet, and their longest side there.
SHEET_PICTURES, SHEET_SIDE = 100, 160

command(
    "info",
    "info",
    "describe a field, cage, pose, edit, camera, place or scene file, or a scene folder; without one this installation",
    """\
  warpcage info
  warpcage info lego.npz
  warpcage info cage.obj
  warpcage info data/lego --split test --sheet lego.png
  warpcage info place --box place.png                        where fit takes the object to be
  warpcage info place --seen seen.png                        from where it was seen
""",
    f"""
field  field (.npz), splats, cage, poses, edits, cameras, places, a scene file (.json) or a scene folder; without one:
    this installation, and the formats of all these files
--split  which pictures of a scene, such as train or test (default: %(default)s)
FitSceneSpec.format
--sheet PICTURE  write a contact sheet of a scene's pictures, at most {SHEET_PICTURES} of them (.png)
--box PICTURE  write a picture of a scene's cameras, points and object's box (.png)
--seen PICTURE  write a map of what the cameras of a scene, or those refined by a field's fit, saw of the object (.png):
    where fewer than three cameras saw it, the field is a guess
--scene SCENE[:SPLIT]  check whether the cameras of this scene see the field
{FRAME}
""",
    SCALE_AND_DEVICE,
    field={"nargs": "?", "metavar": "file"},
    split="train",
    frame=FRAME_VALUE,
)


def _add_actions(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", metavar="action", required=True)
    actions.add_parser("list", help="print the name and the topic of every kernel file")
    copy = actions.add_parser("copy", help="copy a kernel file, or all of a folder, with what they need")
    add_rows(
        copy,
        """
name  kernel file, such as mean_value or coordinates/mean_value, or a folder of them, such as lattice
destination  folder of the copy; Python imports it by this name
--alone  without the modules that launch the kernels, for launches of your own
""",
        destination={"metavar": "DEST"},
    )


command(
    "kernels",
    "info",
    "list the kernel files, or copy some with all that they need into a program of your own",
    """\
  warpcage kernels list
  warpcage kernels copy mean_value my_kernels
  warpcage kernels copy lattice my_maps
  warpcage kernels copy harmonics my_kernels --alone

The copy needs Warp and nothing of warpcage: from my_kernels.coordinates.mean_value import mean_value_position. It has
the modules that launch its kernels, in host/, the licence, and a README.md with a call that runs.
""",
    more=_add_actions,
)

command(
    "demo",
    "doctor",
    "try all steps, from pictures to a bent object, on a small scene that it makes",
    """\
  warpcage demo
  warpcage demo -o out --device cuda:0

Makes an excavator of bricks with pictures of it, fits a field to them, puts a cage around it and bends it. The folder
then has the pictures, the film, the mesh, the cages and the field; the seconds of each step are printed.
""",
    """
-o FOLDER  where results go (default: %(default)s)
--device
""",
    output="warpcage_demo",
)

command(
    "doctor",
    "doctor",
    "check whether warpcage works on this machine, and say how to fix what does not",
    """\
  warpcage doctor
  warpcage doctor --device cuda:0

Versions, devices, driver, memory, kernel cache, codecs, extras, and a test of some seconds. The exit status is 1 where
something keeps it from working.
""",
    """
--device
""",
)
