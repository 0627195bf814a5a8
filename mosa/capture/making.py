"""The way of a capture: videos, poses, mattes, clocks, the fall, the world, frames at common times, and a page on all of it."""

from __future__ import annotations

import json
import logging
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from mosa.capture.alignment import centres_at, coarse_offsets
from mosa.capture.fall import Fall, Knowledge, fit_fall
from mosa.capture.impact import through_impact
from mosa.capture.mattes import Matting, Track, follow, matting_of
from mosa.capture.outline import corrected, radius_of, shifted, without_common
from mosa.capture.phones import Phone
from mosa.capture.poses import read_phones, scene_points
from mosa.capture.report import write_report
from mosa.capture.resampling import common_path, common_times, exposure_of, resampled
from mosa.capture.videos import Clip, find_videos, open_clip, plate_of
from mosa.capture.world import (
    FILE,
    World,
    box_of,
    floor_gains,
    floor_of_points,
    ground_height,
    lowest_points,
    read_world,
    world_of,
    write_images,
    write_transforms,
)  # fmt: skip
from mosa.config.build import plain
from mosa.config.leaf_settings import CaptureSettings
from mosa.errors import ConfigError, DataError
from mosa.system.progress import tqdm
from mosa.system.whole_files import write_whole

log = logging.getLogger(__name__)

READOUT_DIRECTIONS = {0: "down", 90: "left", 180: "up", 270: "right"}
"""Rotation of a video for display [degrees] -> direction of the sensor's readout in the displayed picture."""
MAX_PHONE_OFFSET = 0.12  # disagreement [object radii] above which a phone is reported
CORRECTIONS = 4
"""Times that the fall is fitted again, with the outlines that its hull has. Each time the poses' errors become smaller, and with
them those of the hull: of the rabbit's film 1.3 px at first, then 0.6, 0.5, 0.4 and 0.4."""
FAR_OFF = 1.5  # factor between a given scale and that of the fall that is a mistake
COARSE = 320  # pixels of images in which the ground is looked for


def make(cfg: DictConfig) -> dict[str, Any]:
    """`python -m mosa.capture`: write the scene and its report; returns what capture.json says. Errors: ConfigError, DataError."""
    for key in ("videos", "poses", "output"):
        if OmegaConf.is_missing(cfg, key):
            way = f"python -m mosa.capture {key}=<folder> ..."
            raise ConfigError(f"{key}: expected a folder, found none; {way}")
    values = plain(cfg)
    CaptureSettings.read(values)
    return capture(values)


def capture(values: Mapping[str, Any]) -> dict[str, Any]:
    """From the checked keys of conf/capture.yaml. Errors: ConfigError, DataError."""
    folder = output_folder(values)
    files = find_videos(values["videos"])
    if unknown := set(values["phones"] or {}) - (stems := {file.stem for file in files}):
        raise ConfigError(
            f"phones.{min(unknown)}: no video of that name; there are {', '.join(sorted(stems))}"
        )
    clips = [open_clip(file, of_phone(values, file.stem, "fps")) for file in files]
    sizes = {clip.path.name: clip.size for clip in clips}
    given, plates = read_phones(values["videos"], values["poses"], sizes), plates_folder(values)
    places = plates, values["plate_seconds"], values["masks"]
    mattings = [matting_of(values["mattes"], clip, *places) for clip in clips]
    tracks = followed(clips, mattings)
    like = None if values["like"] is None else read_world(values["like"])
    knowledge = known(values, clips, like)
    flight = None if values["flight"] is None else tuple(map(float, values["flight"]))
    ground = None if values["ground"] is None else np.array(values["ground"], float)
    most, own = float(values["max_offset"]), None if like is not None else ground
    fall, phones, centred = found_fall(given, tracks, knowledge, most, flight, own)
    span = fall.window
    log.info("fall: %.3f to %.3f s on the clock of %s, %d centres", *span, phones[0].name, fall.frames)  # fmt: skip
    common = common_path(phones, tracks, fall, knowledge)
    exposures = [exposure_of(v, *pair, fall, knowledge, common) for v, pair in enumerate(zip(phones, tracks))]  # fmt: skip
    written = {key: values[key] for key in ("before", "after", "rate")}
    times = common_times(exposures, span, **written)
    free = fall
    if knowledge.scale is not None or knowledge.up is not None:
        free = free_fall(phones, tracks, fall.offsets, knowledge, flight)
    world = world_of(fall, phones, ground) if like is None else like
    gains = gains_of(values, phones, clips, plates, world, tracks, fall)
    for v, phone in enumerate(tqdm(phones, desc="frames at common times", unit="phone")):
        pictures = resampled(exposures[v], tracks[v], mattings[v], times)
        if gains is not None:
            pictures[..., :3] = np.round(np.clip(pictures[..., :3] * gains[v], 0, 255))
        write_images(folder, phone, pictures)
    write_transforms(folder, phones, times, world)
    paths = [Track(None, times, each.path(times), np.ones(len(times))) for each in exposures]
    # where the lines of sight meet
    centres = world.points(centres_at(phones, paths, np.zeros(len(phones)), times))
    radius = radius_of(phones, tracks, fall) * world.scale
    floor = {"from": "ground" if like is None else "like", "sd": None, "tilt_degrees": None}
    if like is None and ground is None:
        height, floor = found_floor(values, folder, phones, fall, world, centres, radius)
        world = world.lowered(height)
        centres = centres - [0, height, 0]
        write_transforms(folder, phones, times, world)
    moved = [now.camera.K[:2, 2] - then.camera.K[:2, 2] for now, then in zip(phones, given)]
    told = replace(fall, shifts=fall.shifts + np.stack(moved))
    every = enumerate(zip(phones, clips, tracks))
    found = {"phones": [phone_figures(v, *parts, told, knowledge, gains) for v, parts in every]}
    found |= figures(values, told, free, knowledge, world, times, centres, radius, floor)
    found["warnings"] = warnings_of(found, values, knowledge, phones)
    write_whole(folder / FILE, json.dumps(found, indent=1))
    # the outlines' own centres wander about the body's, and off the parabola
    seen = [
        exposure_of(v, *pair, fall, knowledge, common)
        for v, pair in enumerate(zip(phones, centred))
    ]
    write_report(folder, found, phones, fall, seen, world, times)
    for line in found["warnings"]:
        log.warning("warning: %s", line)
    log.info(
        "%d frames of %d phones in %s; what was found is in %s\n%s",
        len(times), len(phones), folder, folder / "capture.md", found["command"],
    )  # fmt: skip
    return found


def found_floor(
    values, folder: Path, phones: list[Phone], fall: Fall, world: World, centres, radius: float
) -> tuple[float, dict[str, Any]]:
    """(height [m], where it is from and what it may be off by) of the floor, which nobody has said: that among the points of the
    poses' model, else the lowest contact of the hull."""
    scale = min(1.0, COARSE / max(phones[0].camera.size))
    away = [np.linalg.norm(p.camera.centre - fall.position) / p.camera.K[0, 0] for p in phones]
    lowest = lowest_points(folder, centres, radius, scale)
    height, error = ground_height(lowest, float(world.scale * np.mean(away)))
    points, apart = world.points(scene_points(values["poses"])), max(3 * error, 0.3 * radius)
    level = floor_of_points(points, radius, height, apart)
    if level is None:
        return height, {"from": "lowest contact", "sd": error, "tilt_degrees": None}
    return level[0], {"from": "points of the model", "sd": level[1], "tilt_degrees": level[2]}


def output_folder(values: Mapping[str, Any]) -> Path:
    """Made, and tried, before minutes are spent. Errors: DataError where it cannot be written, or is what is read."""
    folder = Path(values["output"])
    for key in ("videos", "poses", "plates", "masks", "like"):
        if values[key] is not None and folder.resolve() == Path(values[key]).resolve():
            raise ConfigError(
                f"output: expected a folder of its own, found that of {key}={values[key]}"
            )
    try:
        (folder / "images").mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        found = f"found none ({error.strerror})"
        raise DataError(
            f"output: {folder}: expected a folder that can be written, {found}"
        ) from error
    return folder


def free_fall(
    phones: list[Phone], tracks: list[Track], offsets: np.ndarray, knowledge: Knowledge, flight: tuple[float, float] | None,
) -> Fall:  # fmt: skip
    """The fall as it is where nobody knows scale and up, of which what is known of them is checked: a known scale pulls the
    acceleration to gravity's, so that a mistake cannot be told afterwards. Errors: ConfigError for an impossible scale or up."""
    free = fit_fall(phones, tracks, offsets, replace(knowledge, scale=None, up=None), flight)
    if knowledge.scale is not None and not 1 / FAR_OFF < knowledge.scale / free.scale < FAR_OFF:
        raise ConfigError(f"scale: expected about {free.scale:.3g} m per unit of the poses, as the object then falls at "
                          f"{knowledge.gravity:g} m/s^2, found {knowledge.scale:g}; check like, fps and gravity too")  # fmt: skip
    if knowledge.up is not None and free.acceleration @ knowledge.up >= 0:
        raise ConfigError(f"up: expected a direction against the fall, found {list(map(float, knowledge.up))}, along which the "
                          "object falls upwards")  # fmt: skip
    return free


def check_ground(fall: Fall, phones: list[Phone], ground: np.ndarray | None) -> None:
    """Errors: ConfigError for a point of the floor (3,) that the object does not fall towards."""
    if ground is None:
        return
    below = float((fall.at(np.array(fall.window[1])) - ground) @ fall.up)
    extent = float(np.ptp([phone.camera.centre for phone in phones], axis=0).max())
    if not 0 < below < extent:
        raise ConfigError(f"ground: expected a point of the floor less than {extent:.3g} (units of the poses, the distance "
                          f"between phones) below where the free fall ends, found one {below:.3g} below it")  # fmt: skip


def found_fall(
    phones: list[Phone], tracks: list[Track], knowledge: Knowledge, most: float, flight: tuple[float, float] | None = None,
    ground: np.ndarray | None = None,
) -> tuple[Fall, list[Phone], list[Track]]:  # fmt: skip
    """The fall from nothing but tracks, the phones turned to where they see it, and the tracks that it was fitted to: rough clocks,
    a parabola, and again with the outlines that the hull has, the impact, and these phones. most [s]: of
    offsets; flight: first and last time [s], ground: a point (3,) of the floor, where they are known. Errors: DataError;
    ConfigError, before the corrections, where what is known contradicts the fall."""
    offsets = coarse_offsets(phones, tracks, most)
    if knowledge.scale is not None or knowledge.up is not None:
        free_fall(phones, tracks, offsets, knowledge, flight)
    fall = fit_fall(phones, tracks, offsets, knowledge, flight)
    check_ground(fall, phones, ground)
    fitted = tracks
    for _ in range(CORRECTIONS):
        better = corrected(phones, tracks, fall, knowledge)
        if better is None:
            log.warning(
                "warning: the mattes have no common hull in the free fall: check poses, mattes"
            )
            break
        fitted, window = better, fall.window if flight is None else flight
        fall = fit_fall(phones, better, fall.offsets, knowledge, window)
        fall = through_impact(phones, better, fall, knowledge)
        shifts = without_common(phones, fall)
        phones = [shifted(phone, shift) for phone, shift in zip(phones, shifts)]
        fall = replace(fall, shifts=fall.shifts - shifts)
    return fall, phones, fitted


def of_phone(values: Mapping[str, Any], name: str, key: str):
    """A key that phones may have of their own."""
    return ((values["phones"] or {}).get(name) or {}).get(key, values[key])


def plates_folder(values: Mapping[str, Any]) -> Path | None:
    """The folder of plates: named, in the videos' folder, or beside it."""
    if values["plates"] is not None:
        if not Path(values["plates"]).is_dir():
            raise DataError(f"plates: folder {values['plates']} not found")
        return Path(values["plates"])
    videos = Path(values["videos"])
    places = videos / "plates", videos.parent / "plates"
    return next((folder for folder in places if folder.is_dir()), None)


def followed(clips: list[Clip], mattings: list[Matting]) -> list[Track]:
    with tqdm(total=sum(len(clip.times) for clip in clips), desc="mattes", unit="frame") as bar:
        return [follow(clip, matting, bar.update) for clip, matting in zip(clips, mattings)]


def known(values: Mapping[str, Any], clips: list[Clip], world: World | None) -> Knowledge:
    """What the keys say beforehand; an earlier capture knows scale and up."""
    turned = {clip.path.stem: READOUT_DIRECTIONS.get(clip.turned, "down") for clip in clips}
    scans = {
        name: of_phone(values, name, "scan").replace("auto", own) for name, own in turned.items()
    }
    readouts = {name: of_phone(values, name, "readout") for name in turned}
    up = None if values["up"] is None else np.array(values["up"], float)
    knowledge = Knowledge(values["gravity"], values["scale"], up, readouts, scans)
    return knowledge if world is None else replace(knowledge, scale=world.scale, up=world.R[1])


def gains_of(values, phones, clips, plates, world, tracks, fall) -> np.ndarray | None:
    """(V, 3) factors on the phones' colours, or None."""
    if values["colours"] == "none" or values["mattes"] != "plates":
        return None
    pictures = [plate_of(plates, clip, values["plate_seconds"]) for clip in clips]
    return floor_gains(phones, pictures, world, radius_of(phones, tracks, fall) * world.scale)


def phone_figures(
    v: int, phone: Phone, clip: Clip, track: Track, fall: Fall, knowledge: Knowledge, gains
) -> dict[str, Any]:
    """What capture.json says of phone number v of a fall."""
    return {
        "name": phone.name, "size": list(clip.size), "fps": round(1 / clip.interval, 4), "frames": len(clip.times),
        "seen": int(track.seen.sum()), "offset": float(fall.offsets[v]), "offset_sd": float(fall.offsets_sd[v]),
        "readout": float(fall.readouts[v]), "readout_sd": float(fall.readouts_sd[v]), "scan": knowledge.scan[phone.name],
        "shift": fall.shifts[v].tolist(), "jitter": clip.jitter, "radius_px": float(np.median(track.radii[track.seen])),
        "gain": None if gains is None else gains[v].tolist(),
    }  # fmt: skip


def figures(
    values, fall: Fall, free: Fall, knowledge: Knowledge, world: World, times, centres, radius: float, floor,
) -> dict[str, Any]:  # fmt: skip
    """What capture.json says beside the phones. free: the fall without what was known of scale and up, which it so checks."""
    box = box_of(centres, radius)
    size = float(np.linalg.norm(free.acceleration))
    along = np.clip(-free.acceleration @ fall.up / size, -1, 1)
    drawn = json.dumps(box, separators=(",", ":"))
    command = (
        f"python train.py scene=transforms scene.path={Path(values['output'])} scene.up=[0,1,0] "
        f"scene.gravity=[0,-{values['gravity']:g},0] 'scene.box={drawn}' prior=neo_hookean"
    )
    return {
        "fall": {"window": list(fall.window), "centres": fall.frames, "noise_px": fall.noise, "acceleration": size * world.scale,
                 "turned_degrees": float(np.degrees(np.arccos(along)))},
        "scale": world.scale, "scale_sd": None if knowledge.scale is not None else fall.scale_sd,
        "up": fall.up.tolist(), "up_sd_degrees": None if knowledge.up is not None else fall.up_sd, "ground": floor,
        "radius": radius, "frames": len(times), "free_frames": int((times <= fall.window[1]).sum()),
        "rate": float(1 / np.diff(times).mean()), "box": box, "start": float(times[0]),
        "world": world.written(), "command": command,
    }  # fmt: skip


SIZES = 0.005, 0.75  # [m] of an object's radius; lengths go with the square of the clock


def warnings_of(
    found: dict[str, Any], values: Mapping[str, Any], knowledge: Knowledge, phones: list[Phone]
) -> list[str]:
    """What a reader has to know before training on it."""
    said, fall, g, ground = [], found.get("fall"), values["gravity"], found["ground"]
    if found["scale_sd"] is not None and (sd := found["scale_sd"] / found["scale"]) > 0.03:
        said.append(
            f"the scale is known to {sd:.1%} only, and a modulus of elasticity to twice that: let "
            "it fall from higher up, or measure a distance and set scale=<metres per unit of the "
            "poses>"
        )
    if knowledge.scale is not None and abs(fall["acceleration"] / g - 1) > 0.03:
        said.append(
            f"with the scale {knowledge.scale:.6g} the object falls with "
            f"{fall['acceleration']:.3g} m/s^2 in place of {g:.3g}: check scale, fps and gravity"
        )
    if knowledge.up is not None and (beside := fall["turned_degrees"]) > 3:
        said.append(f"the object falls {beside:.1f} degrees beside the given up: check up, or like")
    for phone, record in zip(phones, found["phones"]):
        name, own, off = record["name"], 1e3 * record["readout"], np.hypot(*record["shift"])
        if record["jitter"] > 0.5:
            said.append(
                f"{name}: its frames are up to {record['jitter']:.2g} frames off an even rate; the "
                "file's times are used"
            )
        if record["readout_sd"] > 0.006 and knowledge.readout_of(phone.name) is None:
            said.append(
                f"{name}: the fall does not tell how long a readout takes ({own:.0f} +- "
                f"{1e3 * record['readout_sd']:.0f} ms, 15 +- 10 is assumed); each ms changes the "
                "scale"
            )
        if off > MAX_PHONE_OFFSET * record["radius_px"]:
            said.append(
                f"{name}: the object appears {off:.1f} px from where the others see it: a pose or "
                "a matte that is off?"
            )
    if (tilt := ground["tilt_degrees"]) is not None and tilt > 1.5:
        said.append(
            f"the floor's points are tilted against the fall by {tilt:.1f} degrees: a slope, or an "
            "up that is off; scene.ground is a level plane"
        )
    if ground["from"] == "lowest contact" and ground["sd"] > 0.05 * found["radius"]:
        said.append(
            f"the ground is known to {1e3 * ground['sd']:.0f} mm only, from the body's outlines: "
            "name a point of it with ground=[x, y, z], in the poses' world, or film with a phone "
            "at the height of the floor"
        )
    if not SIZES[0] <= found["radius"] <= SIZES[1]:
        said.append(
            f"the object would be {2 * found['radius']:.2g} m across: lengths follow from gravity and the clock alone; "
            "measure one, set scale=, and check fps="
        )
    if found["free_frames"] < 3:
        said.append(f"only {found['free_frames']} frames of free fall are written: raise before=")
    return said
