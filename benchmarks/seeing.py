"""What the reconstruction of the real bird is worth: a camera that no stage has seen, volume, free flight; and pictures of it.

    OMP_NUM_THREADS=1 python benchmarks/seeing.py                                  # a line with the defaults of train.py
    OMP_NUM_THREADS=1 python benchmarks/seeing.py scene.scale=0.5                  # a line with other settings
    OMP_NUM_THREADS=1 python benchmarks/seeing.py --table                          # print what has been measured
    OMP_NUM_THREADS=1 python benchmarks/seeing.py scene.scale=0.5 --pictures docs/images
    OMP_NUM_THREADS=1 python benchmarks/seeing.py --scene rabbit --pictures docs/images    # pictures only

The arguments are overrides of conf/train.yaml, as train.py takes them; the line is named by them. The scene is PAC-NeRF's bird
(conf/scene/pacnerf_bird.yaml), camera 5 is held out of every stage. `derived/visual_hull_track.json` of the scene's folder is read
here for comparing, after the reconstruction, which never opens it.

Every finished line lies as JSON under --out and is not measured again; stages of a reconstruction are cached beside it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from pathlib import Path

from hydra.errors import HydraException
from seeing_figures import BIRD, configuration, measure, see
from seeing_pictures import pictures
from seeing_tables import tables

from mosa.errors import MosaError


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "overrides",
        nargs="*",
        help="of conf/train.yaml, e.g. scene.scale=0.5 simulation.particles=2000",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("outputs/seeing"), help="results and cached stages"
    )
    parser.add_argument("--scene", default=BIRD, help="pictures only, of another scene")
    parser.add_argument(
        "--table", action="store_true", help="only print what has been measured, all lines"
    )
    parser.add_argument(
        "--pictures", type=Path, metavar="FOLDER", help="also draw the pictures of this line"
    )
    args = parser.parse_args()
    if args.table:
        lines = [json.loads(file.read_text()) for file in args.out.glob("*.json")]
        if not lines:
            parser.error(
                f"--table: nothing has been measured into {args.out}; run it without --table first"
            )
        print(tables(sorted(lines, key=lambda line: (len(line["overrides"]), line["overrides"]))))
        return
    if args.scene != BIRD:  # no figures to compare with, but pictures
        for picture in pictures(
            see(configuration(args.overrides, args.out, args.scene)), args.pictures or args.out
        ):
            print(picture)
        return
    # the order of overrides matters to hydra: it is kept
    file = (
        args.out / f"bird-{hashlib.sha256(' '.join(args.overrides).encode()).hexdigest()[:8]}.json"
    )
    if not file.exists():
        print(f"bird, {' '.join(args.overrides) or 'defaults'}", file=sys.stderr)
        args.out.mkdir(parents=True, exist_ok=True)
        measured = measure(args.overrides, args.out)
        partial = file.with_suffix(".tmp")
        partial.write_text(json.dumps(measured, indent=1))
        partial.replace(file)
    print(tables([json.loads(file.read_text())]))
    if args.pictures:
        for picture in pictures(see(configuration(args.overrides, args.out)), args.pictures):
            print(picture)


if __name__ == "__main__":
    try:
        main()
    except (MosaError, HydraException) as error:
        sys.exit(f"{type(error).__name__}: {error}")
