"""Attacks that nobody means: what a researcher's tools, habits and machines do to captures, command lines and processes. Each is to
end in one message, or in exactly what would have come without it ("the same").
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from attacks import ROOT, WORLD, Attack, cube, refuse
from attacks_on_data import capture, cube_obj
from attacks_on_running import SMALL, contents, equal, program
from PIL import Image

from mosa.data.formats.export import export_transforms
from mosa.data.scene import load_scene
from mosa.physics.contact.mesh import field_of_mesh

ROUNDED = 2 / 255
"""By which a picture may differ that was written with other bits."""


def habits_data(folder: Path) -> Iterator[Attack]:
    """Captures as other tools write them."""
    good = capture()
    scene = load_scene(format="transforms", path=str(good), **WORLD)
    masked = export_transforms(scene, folder / "masked", masks=True)
    count = iter(range(1000))

    def load(path: Path, mattes: float = 0.0, colors: float = 0.0, **keys) -> None:
        """The same scene, to so much of a matte and of a colour inside of it."""
        found = load_scene(format="transforms", path=str(path), **WORLD | keys)
        for name, allowed in (("mattes", mattes), ("images", colors)):
            ours, theirs = getattr(found, name), getattr(scene, name)
            if ours.shape != theirs.shape or float((ours - theirs).abs().max()) > allowed + 1e-6:
                raise AssertionError(
                    f"loaded, with other {name}: {float((ours - theirs).abs().max()):.3g}"
                )
        refuse("the same")

    def copied(
        change: Callable[[Path], object], source: Path = good, name: str = "", **told
    ) -> Callable[[], object]:
        def attack():
            place = folder / (name or f"c{next(count)}")
            shutil.copytree(source, place)
            change(place)
            load(place, **told)

        return attack

    def every(change: Callable[[Path], object], pattern: str = "*.png"):
        return lambda place: [change(file) for file in sorted((place / "images").glob(pattern))]

    def listed(change: Callable[[dict], object]):
        def attack(place: Path):
            document = json.loads((place / "transforms.json").read_text())
            for entry in document["frames"]:
                change(entry)
            (place / "transforms.json").write_text(json.dumps(document))

        return attack

    def masks(change: Callable[[np.ndarray], Image.Image]):
        return every(lambda f: change(np.asarray(Image.open(f))).save(f), "*_mask.png")

    def renamed(suffix: str, **options):
        """The pictures in another format, listed so."""

        def attack(place: Path):
            for file in sorted((place / "images").glob("*.png")):
                if not file.stem.endswith("_mask"):
                    Image.open(file).save(file.with_suffix(suffix), **options)
                    file.unlink()
            listed(lambda e: e.update(file_path=e["file_path"].replace(".png", suffix)))(place)

        return attack

    yield (
        "a folder with blanks, umlauts and a bracket",
        copied(lambda p: None, name="My capture ü [1] (final)"),
    )
    yield "a name in another normal form", copied(lambda p: None, name="ho\u0308hle")
    yield (
        "a link to the folder",
        lambda: ((folder / "link").symlink_to(good), load(folder / "link")),
    )
    yield "a path with .. in it", lambda: load(good / ".." / good.name)
    yield (
        "Finder's files beside the pictures",
        copied(
            lambda p: (
                (p / "images" / "._a.png").write_bytes(b"\0\5\x16\7"),
                (p / ".DS_Store").write_bytes(b"\0"),
            )
        ),
    )
    yield (
        "a byte order mark",
        copied(
            lambda p: (p / "transforms.json").write_text(
                (p / "transforms.json").read_text(), encoding="utf-8-sig"
            )
        ),
    )
    yield (
        "UTF-16",
        copied(
            lambda p: (p / "transforms.json").write_text(
                (p / "transforms.json").read_text(), encoding="utf-16"
            )
        ),
    )
    yield (
        "backslashes",
        copied(listed(lambda e: e.update(file_path=e["file_path"].replace("/", "\\")))),
    )
    yield (
        "paths of another machine",
        copied(listed(lambda e: e.update(file_path=f"D:/{e['file_path']}"))),
    )
    yield "capitals at the end of names", copied(every(lambda f: f.rename(f.with_suffix(".PNG"))))
    yield (
        "a listing by another name",
        copied(lambda p: (p / "transforms.json").rename(p / "transforms_train.json")),
    )
    yield "16 bits", copied(every(lambda f: deep(f)), colors=ROUNDED, mattes=ROUNDED)
    yield (
        "a palette with transparency",
        copied(every(lambda f: Image.open(f).quantize(256).save(f)), colors=0.2, mattes=0.2),
    )
    yield "WebP", copied(renamed(".webp", lossless=True, exact=True), colors=ROUNDED)
    yield "TIFF of 8 bits", copied(renamed(".tiff"))
    yield (
        "JPEG beside masks",
        copied(renamed(".jpg", quality=98, subsampling=0), masked, colors=0.5),
    )
    yield "floats of 0 to 255", copied(every(lambda f: floats(f)), masked)
    for turn in (3, 6, 8):
        yield f"EXIF orientation {turn}", copied(every(lambda f, t=turn: turned(f, t)))
    yield "EXIF orientation 1", copied(every(lambda f: turned(f, 1)))
    yield (
        "masks of 0 and 1",
        copied(masks(lambda m: Image.fromarray((m > 127).astype(np.uint8))), masked),
    )
    yield "masks inverted", copied(masks(lambda m: Image.fromarray(255 - m)), masked)
    yield (
        "masks of another size",
        copied(
            masks(lambda m: Image.fromarray(m).resize((m.shape[1] // 2, m.shape[0] // 2))), masked
        ),
    )
    yield (
        "masks in three equal channels",
        copied(masks(lambda m: Image.fromarray(np.stack([m] * 3, -1))), masked),
    )
    yield (
        "masks of a green label",
        copied(masks(lambda m: Image.fromarray(np.stack([0 * m, m, 0 * m], -1))), masked),
    )
    yield "masks of a label's palette", copied(masks(lambda m: labels(m)), masked)
    yield (
        "masks in an alpha channel",
        copied(masks(lambda m: Image.fromarray(np.stack([m // 3, m // 2, 0 * m, m], -1))), masked),
    )
    yield (
        "masks in the alpha of black",
        copied(masks(lambda m: Image.fromarray(np.stack([0 * m, 0 * m, 0 * m, m], -1))), masked),
    )
    yield (
        "the pictures as their masks",
        copied(listed(lambda e: e.update(mask_path=e["file_path"])), masked),
    )
    yield (
        "one mask for all",
        copied(
            listed(
                lambda e: e.update(
                    mask_path="images/"
                    + sorted(f.name for f in (masked / "images").glob("*_mask.png"))[0]
                )
            ),
            masked,
        ),
    )
    yield (
        "a mask missing",
        copied(lambda p: next((p / "images").glob("*_mask.png")).unlink(), masked),
    )
    yield "further frames of one camera", copied(lambda p: longer(p))
    yield (
        "poses from the world to the camera",
        copied(
            listed(
                lambda e: e.update(
                    transform_matrix=np.linalg.inv(np.array(e["transform_matrix"])).tolist()
                )
            )
        ),
    )
    yield (
        "poses in OpenCV's axes",
        copied(
            listed(
                lambda e: e.update(
                    transform_matrix=(
                        np.array(e["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])
                    ).tolist()
                )
            )
        ),
    )
    yield (
        "poses in millimetres",
        copied(
            listed(
                lambda e: [row.__setitem__(3, 1000 * row[3]) for row in e["transform_matrix"][:3]]
            )
        ),
    )
    yield (
        "poses in feet",
        copied(
            listed(
                lambda e: [row.__setitem__(3, 3.281 * row[3]) for row in e["transform_matrix"][:3]]
            )
        ),
    )
    yield "times in milliseconds", copied(listed(lambda e: e.update(time=1000 * e["time"])))
    yield "times as frame numbers", copied(listed(lambda e: e.update(time=round(60 * e["time"]))))
    yield "focal lengths in millimetres", copied(listed(lambda e: e.update(fl_x=35.0, fl_y=35.0)))
    yield (
        "focal lengths over the width",
        copied(listed(lambda e: e.update(fl_x=e["fl_x"] / 80, fl_y=e["fl_y"] / 80))),
    )
    yield from nested_meshes(folder)


def deep(file: Path) -> None:
    import cv2

    pixels = np.asarray(Image.open(file)).astype(np.uint16) * 257
    cv2.imwrite(str(file), cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGRA))


def floats(file: Path) -> None:
    if not file.stem.endswith("_mask"):
        import cv2

        pixels = np.asarray(Image.open(file).convert("RGB")).astype(np.float32)
        cv2.imwrite(str(file.with_suffix(".tiff")), pixels)
        file.with_suffix(".tiff").rename(file)


def turned(file: Path, orientation: int) -> None:
    with Image.open(file) as picture:
        exif = picture.getexif()
        exif[0x0112] = orientation
        picture.load()
        picture.save(file, exif=exif)


def labels(mask: np.ndarray) -> Image.Image:
    made = Image.fromarray((mask > 127).astype(np.uint8), "P")
    made.putpalette([0, 0, 0, 0, 128, 0] + [0] * 762)
    return made


def longer(place: Path) -> None:
    document = json.loads((place / "transforms.json").read_text())
    last = [e for e in document["frames"] if e["camera"] == document["frames"][0]["camera"]][-1]
    document["frames"] += [{**last, "time": last["time"] + k / 60} for k in (1, 2)]
    (place / "transforms.json").write_text(json.dumps(document))


def nested_meshes(folder: Path) -> Iterator[Attack]:
    """Solids in solids, and units of a CAD program."""
    outer, inner = cube_obj(), cube_obj([(0.25 + 0.5 * x, 0.25 + 0.5 * y, 0.25 + 0.5 * z) for x in (0, 1) for y in (0, 1)
                                         for z in (0, 1)])  # fmt: skip
    again = "\n".join("f " + " ".join(str(int(i) + 8) for i in line.split()[1:]) if line[0] == "f" else line
                      for line in inner.splitlines())  # fmt: skip
    large = cube_obj(
        [
            (1000.0 * (x - 0.5), 1000.0 * (y - 0.5), 1000.0 * (z - 0.5))
            for x in (0, 1)
            for y in (0, 1)
            for z in (0, 1)
        ]
    )
    for name, text in {"a solid in a solid": outer + again,
                       "a solid twice": outer + again.replace("0.25", "0").replace("0.75", "1"),
                       "a cube of millimetres around all": large}.items():  # fmt: skip

        def attack(name=name, text=text):
            (folder / "n.obj").write_text(text)
            field_of_mesh(folder / "n.obj")
            cube().simulate(
                frames=2,
                colliders=[
                    {"type": "mesh", "path": str(folder / "n.obj"), "position": [0, -0.5, 0]}
                ],
            )

        yield f"mesh: {name}", attack


# -------------------------------------------------------------------------------------------------------------------------- keys


def habits_keys(folder: Path) -> Iterator[Attack]:
    """Command lines and YAML files as they are typed; whole processes, which end before anything long has run."""
    written = folder / "conf" / "experiment"
    written.mkdir(parents=True)

    def yaml(name: str, text: bytes) -> list[str]:
        (written / f"{name}.yaml").write_bytes(b"# @package _global_\n" + text)
        return ["--config-dir", str(folder / "conf"), f"experiment={name}"]

    def one_message(*words: str) -> None:
        told = program(
            *([] if "hydra.run.dir=" in words else [f"hydra.run.dir={folder}/run"]),
            *words,
            wanted=2,
        )
        if not told.strip():
            raise AssertionError("nothing said")
        refuse("one message")

    wrong = [
        "simulation.particles", "simulation.particles =200", "simulation.particles= 2 00",
        "--simulation.particles=200", "-simulation.particles=200", "simulation.particles:200",
        "+scene=rabbit", "scene=Rabbit", "scene=conf/scene/rabbit", "scene=",
        "prior=neo-hookean", "prior.E=1e5", "E=1e5", "seed=0,1", "seed=[0,1]", "seed=1.5",
        "simulation.particles=2e3.5", "simulation.particles=2k", "simulation.particles='2000'",
        "simulation.particles=[2000]", "fit.joint.iterations=[1,2]", "prior.parameters.E=[1e5,2e5]",
        "prior.parameters.E=-1", "prior.parameters.nu=0.5", "prior.parameters.nu=30",
        "scene.gravity=9.81", "scene.gravity=[0,9.81]", "evaluation.video=on", "evaluation.video=1",
        "trainer.accelerator=mps", "trainer.devices=cuda", "extensions=[no_such_module]",
        "extensions=no_such_module", "world.colliders=sphere", "scene.path=", "hydra.run.dir=",
        "+experiment=none", "resume=true", "ckpt_path=outputs", "logger=tensorbord",
        "+simulation={particles: 5", "scene.also_train=test_60,test_40",
    ]  # fmt: skip
    for words in wrong:
        yield words, lambda w=words: one_message("debug=default", w)
    yield "a tab in YAML", lambda: one_message(*yaml("tab", b"simulation:\n\tparticles: 200\n"))
    yield "a key twice in YAML", lambda: one_message(*yaml("twice", b"seed: 1\nseed: 2\n"))
    yield (
        "no blank after a colon",
        lambda: one_message(*yaml("colon", b"simulation:\n  particles:200\n")),
    )
    yield (
        "YAML in Latin-1",
        lambda: one_message(*yaml("latin", "scene:\n  path: /höhle\n".encode("latin-1"))),
    )
    yield "YAML that is a list", lambda: one_message(*yaml("list", b"- seed: 1\n"))
    yield (
        "an unknown key in YAML",
        lambda: one_message(*yaml("unknown", b"simulation:\n  partciles: 200\n")),
    )
    yield "a config that is none", lambda: one_message("--config-name", "nothing")
    yield "eval's config in train", lambda: one_message("--config-name", "eval")
    yield (
        "a sweep over nothing",
        lambda: (
            program("-m", "seed=", f"hydra.sweep.dir={folder}/sweep", wanted=1),
            refuse("one message, and a sweep's exit code"),
        ),
    )


# ----------------------------------------------------------------------------------------------------------------------- running


def habits_running(folder: Path) -> Iterator[Attack]:
    """Processes on machines as they are: interpreter's flags, environments, users, signals, folders that are shared."""
    cache, base = folder / "cache", folder / "base"
    program(*SMALL, f"hydra.run.dir={base}", f"scene.cache={cache}")
    whole = contents(base)

    def fitted(name: str) -> Path:
        shutil.copytree(base / "checkpoints", folder / name / "checkpoints")
        return folder / name

    def words(run: Path, used: Path = cache) -> list[str]:
        return [*SMALL, f"hydra.run.dir={run}", f"scene.cache={used}", "resume=auto"]

    def same(name: str, shell: str, **told) -> None:
        run = fitted(name)
        program(*words(run), shell=shell, **told)
        equal(whole, run)

    python = sys.executable
    for name, shell in {
        "O": "PYTHONOPTIMIZE=1 {}", "OO": "PYTHONOPTIMIZE=2 {}", "no_bytecode": "PYTHONDONTWRITEBYTECODE=1 {}",
        "dev_mode": "PYTHONDEVMODE=1 {}", "hash_seed": "PYTHONHASHSEED=7 {}", "ascii_screen": "PYTHONIOENCODING=ascii:strict {}",
        "no_input": "{} <&-", "umask": "umask 077; {}", "narrow_screen": "TERM=dumb COLUMNS=1 {}",
        "turkish": "LC_ALL=tr_TR.UTF-8 {}",
        "no_gpu": "CUDA_VISIBLE_DEVICES=7 {}", "threads_0": "OMP_NUM_THREADS=0 {}", "threads_word": "OMP_NUM_THREADS=many {}",
        "slurm": "SLURM_JOB_ID=1 SLURM_NTASKS=4 SLURM_PROCID=0 SLURM_LOCALID=0 SLURM_NODELIST=a {}",
        "mpi": "OMPI_COMM_WORLD_SIZE=4 OMPI_COMM_WORLD_RANK=0 {}", "world_size": "WORLD_SIZE=2 RANK=0 {}",
        "empty_cache_home": "XDG_CACHE_HOME= {}",
        "matplotlib": "MPLBACKEND=TkAgg DISPLAY= {}", "proxy": "http_proxy=http://127.0.0.1:1 https_proxy=http://127.0.0.1:1 {}",
    }.items():  # fmt: skip
        yield f"goes on: {name}", lambda n=name, s=shell: same(n, s)
    for name in ("error::UserWarning", "error"):  # one of ours, or of a library's import, ends it
        yield f"PYTHONWARNINGS={name}", lambda n=name: (program(*words(fitted(n)), shell=f"PYTHONWARNINGS={n} {{}}", wanted=2),
                                                        refuse("one message"))  # fmt: skip
    yield "XDG_CACHE_HOME is a file", lambda: (program(*words(fitted("file")), shell=f"XDG_CACHE_HOME={ROOT}/README.md {{}}",
                                                       wanted=2), refuse("one message"))  # fmt: skip
    yield "from another folder", lambda: elsewhere(fitted, words, whole, folder, python)

    def stopped_twice(name: str, pause: float) -> None:
        run = folder / name
        process = subprocess.Popen([python, str(ROOT / "train.py"), *words(run)], cwd=ROOT, stdout=subprocess.DEVNULL,
                                   stderr=subprocess.PIPE, text=True,
                                   preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler))  # fmt: skip
        log = run / "train.log"
        while process.poll() is None and not (log.is_file() and "] fit: " in log.read_text()):
            time.sleep(0.05)
        for _ in range(2):
            process.send_signal(signal.SIGINT)
            time.sleep(pause)
        told = process.communicate()[1]
        if process.returncode not in (130, -signal.SIGINT) or "Traceback" in told:
            raise AssertionError(f"exit code {process.returncode}: {told[-400:]}")
        program(*words(run))
        equal(whole, run)

    for pause in (0.01, 0.3):
        yield (
            f"Ctrl-C twice, {pause} s apart, in the fit",
            lambda p=pause: stopped_twice(f"twice_{p}", p),
        )
    for name in ("SIGHUP", "SIGUSR1", "SIGQUIT"):

        def hung_up(name=name):
            run = fitted(name)
            program(*words(run), seconds=9.0, sign=getattr(signal, name), wanted=None)
            program(*words(run))
            equal(whole, run)

        yield f"{name} as a batch system or a closed terminal sends it", hung_up

    def paused() -> None:
        run = fitted("paused")
        process = subprocess.Popen([python, str(ROOT / "train.py"), *words(run)], cwd=ROOT, stdout=subprocess.DEVNULL,
                                   stderr=subprocess.DEVNULL)  # fmt: skip
        for _ in range(3):
            time.sleep(2.0)
            process.send_signal(signal.SIGSTOP)
            time.sleep(0.5)
            process.send_signal(signal.SIGCONT)
        if process.wait():
            raise AssertionError(f"exit code {process.returncode}")
        equal(whole, run)

    yield "stopped and continued (Ctrl-Z, fg)", paused

    def two_sweeps() -> None:
        """The second one finds folders that are being written, or are complete."""
        sweep = ["-m", *SMALL, "evaluation.video=false", f"scene.cache={cache}", f"hydra.sweep.dir={folder}/sweeps", "resume=auto",
                 "hydra.sweep.subdir=${hydra.job.num}", "identification.count=30.0,20.0"]  # fmt: skip
        environment = {
            **os.environ,
            "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
        }
        first = subprocess.Popen([python, str(ROOT / "train.py"), *sweep], cwd=ROOT, env=environment, stdout=subprocess.DEVNULL,
                                 stderr=subprocess.PIPE, text=True)  # fmt: skip
        while first.poll() is None and not (folder / "sweeps" / "0" / "train.log").is_file():
            time.sleep(0.05)
        second = program(*sweep, wanted=None)
        told = first.communicate()[1]
        if "Traceback" in told + second:
            raise AssertionError(told[-300:] + second[-300:])
        program(*sweep)
        made = [
            json.loads((folder / "sweeps" / str(k) / "metrics.json").read_text())["id/E"]
            for k in range(2)
        ]
        if len(set(made)) != 2 or not np.isfinite(made).all():
            raise AssertionError(f"{made}")
        refuse("both complete, the second said which was taken")

    yield "two sweeps in one folder", two_sweeps


def elsewhere(fitted: Callable, words: Callable, whole: dict, folder: Path, python: str) -> None:
    run, place = fitted("elsewhere"), folder / "a place of its own"
    place.mkdir()
    program(*words(run), cwd=place)
    equal(whole, run)
