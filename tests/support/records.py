"""Writes records that tests compare with what is made now, where that is another on purpose; look at `git diff` then.

python tests/support/records.py help                  # tests/data/help: --help of all commands
python tests/support/records.py pictures "fit" "bake"  # tests/data/pictures.npz: these cases of picture_hashes.py
python tests/support/records.py video                 # tests/studio/captures/phone_video.mp4
"""

import pathlib
import sys

import numpy as np

CONTRACTS = pathlib.Path(__file__).resolve().parents[1] / "contracts"


def write_help(folder):
    """Write the help that is not the recorded one; that of other versions of Python is laid out in another way."""
    import golden_names

    for name in ("", *golden_names.commands()):
        path, now = folder / f"{name or golden_names.PROGRAM}.txt", golden_names.help_text(name)
        if not path.exists() or golden_names.plain_help(path.read_text("utf-8")) != golden_names.plain_help(now):
            path.write_text(now, "utf-8")
            print("wrote", path)


def write_pictures(names, path):
    """Renew the summaries of some cases; those of cases that are no more are dropped."""
    import picture_hashes

    held = picture_hashes.read_golden()
    found = {}
    for case in picture_hashes.CASES:
        if case in names:
            found |= {
                f"{case}: {key}": picture_hashes.summary(array) for key, array in picture_hashes.made(case).items()
            }
        else:
            found |= {key: values for key, values in held.items() if key.startswith(f"{case}: ")}
    values = list(found.values())
    np.savez_compressed(
        path,
        names=np.array(list(found)),
        lengths=np.array([len(each) for each in values]),
        values=np.concatenate(values),
    )


if __name__ == "__main__":
    sys.path.append(str(CONTRACTS))
    import picture_hashes

    kind, *cases = sys.argv[1:] or ("",)
    if kind == "help" and not cases:
        write_help(CONTRACTS.parent / "data" / "help")
    elif kind == "video" and not cases:
        from ground_truth import write_phone_video
        from scenes import PHONE_VIDEO

        write_phone_video(CONTRACTS.parent / "studio" / "captures" / "phone_video.mp4", device="cpu", **PHONE_VIDEO)
    elif kind == "pictures" and cases and set(cases) <= set(picture_hashes.CASES):
        write_pictures(cases, picture_hashes.GOLDEN)
    else:
        sys.exit(f"{__doc__}\ncases: {'; '.join(picture_hashes.CASES)}")
