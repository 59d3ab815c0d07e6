"""Command lines that must be refused: each drawn by a seeded generator, with the files that it needs."""

import functools
import json
import os
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from data_files import write_images, write_text
from forecast_clips import write_clip

Rng = np.random.Generator


@dataclass
class Case:
    """A command line: of vestcl, or of a script of train."""

    what: str
    arguments: list[str]
    program: str = "vestcl"
    environment: dict[str, str] = field(default_factory=dict)


Draw = Callable[[Rng, Path], Case]

#: Numbers that no option takes.
NUMBERS = ("nan", "-inf", "inf", "-1", "-7", "1e400", "100000000000", "abc", "", " ", "0x10", "1,5", "9" * 5000, "--")
#: Options that take whole numbers (with values out of their range), by command; what comes before them is sound.
WHOLE = {
    "forecast": {
        **dict.fromkeys(("--steps", "--height", "--width"), ("0", "-3", "10000000", "2.5")),
        "--frame": ("-1", "600", "1.5"),
    },
    "prepare": {
        **dict.fromkeys(("--height", "--width"), ("0", "10000000", "nan")),
        "--frames": ("0", "1", "-4", "1000000"),
        "--samples": ("0", "-1", "1000"),
        "--workers": ("0", "-2", "100000"),
    },
    "demo": {**dict.fromkeys(("--height", "--width"), ("0", "-8", "10000000")), "--seed": ("-1", "one", "1.0")},
}
REALS = {"forecast": ("--fov", "--depth-scale"), "prepare": ("--fov", "--depth-scale"), "doctor": ("--timeout",)}
VIEWS = (
    *("above", "1", "1,2", "1,2,3,4", "a,b,c", "nan,0,0", "0,0,inf", "0,0,0,yaw", "0,0,0,yaw=", "0,0,0,yaw=x", ",,"),
    *("0,0,0,yaw=1,yaw=2", "0,0,0,fov=0", "0,0,0,fov=180", "0,0,0,fov=-5", "0,0,0,name=../x", "0,0,0,name=", "0;0;0"),
    *("0,0,0,name=.hidden", "0,0,0,zoom=2", "source,right", "SOURCE", "0,0,0,name=forecast.json", "1e400,0,0", "le ft"),
    "0,0,0,name=" + "n" * 300,
)
SHARDS = ("1/1", "2/2", "-1/2", "a/b", "1", "1/0", "/", "1/2/3", "0/0", "1.0/2", "½/2")
INPUTS = (
    *("nowhere", "street:abc", "street:-1", "street:1.5", "street:0x3", "street: 3", "street:99999999999999999999"),
    *("https://example.com/clip.mp4", "file:///clip.mp4", "rtsp://camera/1", "-", "~nobody/clip", "a" * 5000, "*.png"),
    *("/dev/null", "/proc/self/mem", "/", "street:5 ", "Street:5", "s3://bucket/clip", "clip\tname", "\udcff.mp4"),
)
BENCHES = {
    "splat": {"--radii": NUMBERS[:5], "--seconds": ("0", *NUMBERS[:5]), "--threads": ("0", "-1"), "--height": ("0",)},
    "operators": {"--channels": ("0", "-1", "10000000"), "--radius": ("0", *NUMBERS[:4]), "--width": ("0", "10000000")},
    "pipeline": {"--frames": ("0", "1"), "--height": ("0", "33"), "--model": ("nowhere",), "--scenes": ("beach",)},
    "train-step": {"--batch": ("0", "-1"), "--model": ("nowhere",), "--seconds": ("nan", "0"), "--width": ("0",)},
    "network": {"--runs": ("0", "-1"), "--model": ("nowhere",), "--batch": ("0",), "--device": ("abacus",)},
    "pareto": {"--runs": ("0",), "--seeds": ("-1", "x"), "--model": ("nowhere",), "--height": ("0",)},
    "stability": {"--families": ("abacus",), "--device": ("99:9",), "--threads": ("0",)},
    "inpaint": {"--streets": ("0", "-1"), "--methods": ("abacus",), "--device": ("abacus",)},
    "forecast": {"street:0 --steps": ("0", "-1", "100000000000"), "street:0 --horizons": ("0", "9", "-1")},
}
OUTS = ("", "FILE", "FILE/below", "NAME", "/proc/nothing/here")


# ---------------------------------------------------------------- options


def number(rng: Rng, folder: Path) -> Case:
    command = pick(rng, sorted(WHOLE))
    option = pick(rng, sorted(WHOLE[command]))
    value = pick(rng, (*WHOLE[command][option], *NUMBERS))
    if option == "--seed" and value == "100000000000":
        value = "-1"
    return Case("number", [*sound(command, folder), option, value])


def real(rng: Rng, folder: Path) -> Case:
    command = pick(rng, sorted(REALS))
    option = pick(rng, REALS[command])
    value = pick(rng, ("0", "-1.5", *NUMBERS))
    return Case("real number", [*sound(command, folder), option, value])


def output(rng: Rng, folder: Path) -> Case:
    write_text(folder / "file", "")
    value = pick(rng, OUTS).replace("FILE", str(folder / "file")).replace("NAME", "n" * 5000)
    command = pick(rng, ("forecast", "prepare", "demo"))
    return Case("output", [*sound(command, folder, out=False), "--out", value])


def view(rng: Rng, folder: Path) -> Case:
    names = ["--view", pick(rng, VIEWS)]
    if rng.random() < 0.2:
        names = ["--view", "right", "--view", "right"]
    return Case("view", [*sound("forecast", folder), *names])


def together(rng: Rng, folder: Path) -> Case:
    """Options that need others, or do not go with the input."""
    write_text(folder / "file.pth", "weights")
    options = pick(
        rng,
        (
            *("--depth-scale 256", "--label-ids labelIds", "--mode feedback", "--quality fast", "--rig grey"),
            *("--squeeze file.pth", "--squeeze file.pth --compare --steps 1", "--sequence 00", "--snippet x"),
            *(
                "--variant clone",
                "--depth nowhere",
                "--labels nowhere",
                "--depth file.pth",
                "--fov 60",
                "--device abacus",
            ),
            *("--device 99:0", "--frame 99", "--compare --steps 99", "--compare --steps 1 --view 0,0,1", "--gif yes"),
            *("--depth-model nowhere", "--mask-model nowhere", "--label-ids abacus", "--mode neither", "--dance"),
            *("--score-size 256 832", "--score-size 0 9 --compare --steps 1", "--score-size 256"),
            *("--model nowhere", "--model file.pth", "--quality best", "--view", "--steps", "second.input"),
        ),
    )
    return Case("options together", [*sound("forecast", folder), *options.split()])


def inputs(rng: Rng, folder: Path) -> Case:
    command, text = pick(rng, ("forecast", "prepare", "bench forecast")), pick(rng, INPUTS)
    if rng.random() < 0.15:
        command, text = "forecast", pick(rng, ("street:1-3", "street:"))
    return Case("input", [*command.split(), text, "--out", str(folder / "out")])


def prepare(rng: Rng, folder: Path) -> Case:
    arguments = pick(
        rng,
        (
            ["street:5"], ["street:5-2", "--out", "o"], ["street:0-999999999999", "--out", "o"], ["--out", "o"],
            ["street:1", "street:1", "--out", "o"], ["street:1", "--out", "o", "--shard", pick(rng, SHARDS)],
            ["street:1", "--out", "o", "--drive", "wild"], ["street:1", "--out", "o", "--street-depth", "guess"],
            ["street:1", "--out", "o", "--fov", "60"], ["street:1", "--out", "o", "--depth-scale", "256"],
            ["street:1", "--out", "o", "--mask-model", "x"], ["street:1", "nowhere", "--out", "o"],
        ),
    )  # fmt: skip
    return Case("prepare", ["prepare", *arguments])


def plain(rng: Rng, folder: Path) -> Case:
    arguments = pick(
        rng,
        (
            *("", "dance", "devices now", "doctor --timeout", "demo --model nowhere", "demo --quality best", "bench"),
            *("demo --device abacus", "bench abacus", "--versions", "forecast", "demo --seed", "doctor --loud"),
            *("demo --out", "bench splat --dance", "bench compare", "bench compare nowhere nowhere"),
        ),
    )
    return Case("plain", arguments.split())


def environment(rng: Rng, folder: Path) -> Case:
    chosen = pick(rng, ("abacus", "99:99", "0:0:0", "-1", "*"))
    return Case(
        "environment", pick(rng, (["devices"], sound("forecast", folder))), environment={"VESTCL_DEVICE": chosen}
    )


def bench(rng: Rng, folder: Path) -> Case:
    name = pick(rng, sorted(BENCHES))
    option = pick(rng, sorted(BENCHES[name]))
    if rng.random() < 0.15:
        write_text(folder / "file", "no json")
        return Case(
            "bench", ["bench", *pick(rng, (["compare", str(folder / "file")] * 2, ["splat", "--json", str(folder)]))]
        )
    return Case("bench", ["bench", name, *option.split(), pick(rng, BENCHES[name][option])])


# ---------------------------------------------------------------- train


def train(rng: Rng, folder: Path) -> Case:
    model, text = folder / "model.safetensors", folder / "run.yaml"
    model.write_bytes(rng.bytes(100) if rng.random() < 0.5 else struct.pack("<Q", 1 << 60) + b"{}")
    write_text(text, pick(rng, ("a: [", "- 1", "name: x", "steps: many", "base: run.yaml", "? x", "!!python/object:x")))
    write_text(folder / "file", "")
    evaluate = (
        *("", "kitti", "abacus", "street --model nowhere", f"street --model {model}", "street --steps 0"),
        *("street --horizons 99", "street --seeds 9 1", "street --seeds -1 1", "street --every 0", "street --first -1"),
        *("street --height 0", "street --width 10000000", "street --shard 3/2", "street --lpips a b", "clip --data x"),
        *(f"street --out {folder / 'file'}", "street --squeeze nowhere", "street --device abacus", "street --mode x"),
    )
    fit = (
        *("", "nowhere.yaml", str(text), str(folder), f"{text} name", f"{text} a.b.c=1", "--resume", f"{text} ="),
        *(f"{text} data.train=nowhere", f"{text} model=abacus", f"{text} --device abacus", f"{text} stages.0.steps=-1"),
    )
    export = (
        "",
        "nowhere out.safetensors",
        f"{model} out.safetensors",
        f"{model} {folder}",
        f"{folder} o",
        "street:1 x",
    )
    card = ("", "nowhere", str(folder), f"{folder} --results nowhere", f"{folder} --out {folder / 'file'}")
    program, choices = pick(rng, (("evaluate", evaluate), ("fit", fit), ("export", export), ("card", card)))
    return Case(f"train.{program}", pick(rng, choices).split(), f"train.{program}")


# ---------------------------------------------------------------- files


def file_of_clip(rng: Rng, folder: Path) -> Case:
    """A clip whose frames, or the files next to them, are damaged."""
    clip = write_clip(folder / "clip")
    damage = pick(rng, DAMAGES)
    damage(rng, clip)
    command = pick(rng, ("forecast", "prepare"))
    small = ["--height", "16", "--width", "32"]  # for frames that are computed before the damaged one is seen
    return Case(f"file: {damage.__name__}", [command, str(clip), *small, "--out", str(folder / "out")])


def camera_key(rng: Rng, clip: Path) -> None:
    camera = json.loads((clip / "camera.json").read_text())
    camera[pick(rng, ("fx", "fy", "cx", "cy", "fps", "baseline"))] = pick(rng, (None, "40", -1, [], {}, True, 1e300))
    if camera.get("fps", 0) is None or camera.get("baseline", 0) is None:
        camera["fx"] = "wide"
    if rng.random() < 0.5:
        camera[pick(rng, ("focal", "width", "pixel_centre", "right", "depth_scale"))] = pick(rng, ("x", -1, []))
    write_text(clip / "camera.json", json.dumps(camera))


def camera_text(rng: Rng, clip: Path) -> None:
    texts = (b"", b"{", b"[]", b"null", b"\xff\xfe{}", b"[" * 100000, b"{}", b'{"fx": 1e999}', b"0" * 10000)
    (clip / "camera.json").write_bytes(pick(rng, texts))


def camera_missing(rng: Rng, clip: Path) -> None:
    (clip / "camera.json").unlink()
    if rng.random() < 0.5:
        (clip / "camera.json").mkdir()


def frame_bytes(rng: Rng, clip: Path) -> None:
    path = pick(rng, sorted((clip / "image").iterdir())[-2:])
    content = path.read_bytes()
    path.write_bytes(pick(rng, (b"", b"no image", content[:30], rng.bytes(500), giant_png())))


def frame_size(rng: Rng, clip: Path) -> None:
    write_images(clip / "image", ["0005.png"], 7, int(rng.integers(1, 30)))


def frame_special(rng: Rng, clip: Path) -> None:
    path = clip / "image" / "0005.png"
    path.unlink()
    pick(rng, (os.mkfifo, os.mkdir, functools.partial(os.symlink, "nowhere")))(path)


def no_frames(rng: Rng, clip: Path) -> None:
    for path in sorted((clip / "image").iterdir())[int(rng.integers(2)) :]:
        path.unlink()


def table(rng: Rng, clip: Path) -> None:
    name = pick(rng, ("poses.txt", "times.txt"))
    texts = ("", "x\n" * 6, "nan\n" * 6, "1\n" * 5, "1 2 3\n" * 6, "0 " * 12 + "\n", "1e999\n" * 6, "\0" * 9, "1\n" * 6)
    (clip / name).write_text(pick(rng, texts[:-1]))


def depth_file(rng: Rng, clip: Path) -> None:
    (clip / "depth").mkdir()
    npy = b"\x93NUMPY\x01\x00v\x00"
    head = "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 1000000), }"
    contents = (b"", npy, npy + f"{head:<117}\n".encode(), b"\x93NUMPY\x01\x00\xff\xff{", rng.bytes(100))
    for index in range(6):
        np.save(clip / "depth" / f"000{index}.npy", np.ones((24, 40), np.float32))
    (clip / "depth" / "0005.npy").write_bytes(pick(rng, contents))


def giant_png() -> bytes:
    """A header of 2^31 - 1 by 2^31 - 1 pixels, and nothing else."""

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    header = struct.pack(">IIBBBBB", 2**31 - 1, 2**31 - 1, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"") + chunk(b"IEND", b"")


def lone_file(rng: Rng, folder: Path) -> Case:
    """In place of a clip."""
    name = pick(rng, ("clip.mp4", "clip.MKV", "clip.avi", "clip", "clip.png", "clip.json"))
    path = folder / name
    if rng.random() < 0.2:
        os.mkfifo(path)
    else:
        path.write_bytes(pick(rng, (b"", b"text", rng.bytes(2000), b"\0\0\0\x18ftypmp42" + rng.bytes(500))))
    return Case("lone file", ["forecast", str(path), "--out", str(folder / "out")])


def layout(rng: Rng, folder: Path) -> Case:
    """A folder that looks like a data set."""
    clip = folder / "2011_09_26_drive_0001_sync"
    write_images(clip / "image_02" / "data", ["0000000000.png", pick(rng, ("0000000002.png", "x.png"))])
    if rng.random() < 0.5:
        for name in ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt"):
            write_text(
                folder / name, pick(rng, ("", "P_rect_02: 1 2 3", "P_rect_02: " + "nan " * 12, "S_rect_02: 0 0"))
            )
    which = pick(rng, ("raw", "odometry", "cityscapes", "virtual"))
    if which == "odometry":
        write_text(folder / "o" / "calib.txt", pick(rng, ("", "P0: 1", "P2: " + "0 " * 12)))
        clip = folder / "o"
    elif which == "cityscapes":
        write_images(folder / "c" / "leftImg8bit_sequence" / "val" / "ulm", ["ulm_000000_000000_leftImg8bit.png"])
        clip = folder / "c"
    elif which == "virtual":
        write_images(folder / "v" / "frames" / "rgb" / "Camera_0", ["rgb_00000.jpg"])
        clip = folder / "v"
    return Case(f"layout: {which}", ["forecast", str(clip), "--out", str(folder / "out")])


def model_file(rng: Rng, folder: Path) -> Case:
    path = folder / "model.safetensors"
    header = json.dumps({"a": {"dtype": "F32", "shape": [1 << 40], "data_offsets": [0, 1 << 42]}}).encode()
    contents = (b"", b"text", rng.bytes(200), struct.pack("<Q", len(header)) + header, struct.pack("<Q", 1 << 62))
    kind = int(rng.integers(3))
    if kind == 0:
        path.mkdir()
    elif kind == 1:
        os.mkfifo(path)
    else:
        path.write_bytes(pick(rng, contents))
    return Case("model", [*sound(pick(rng, ("forecast", "demo")), folder), "--model", str(path)])


DAMAGES = (
    *(camera_key, camera_text, camera_missing, frame_bytes, frame_size, frame_special, no_frames, table, depth_file),
)
DRAWS: Sequence[Draw] = (
    *(number, number, real, output, view, together, together, inputs, prepare, plain, environment, bench, bench, train),
    *(train, file_of_clip, file_of_clip, lone_file, layout, model_file),
)


def draw(seed: int, index: int, folder: Path) -> Case:
    """Case ``index``; its files are in ``folder``, where it is to be run."""
    rng = np.random.default_rng([seed, index])
    return DRAWS[index % len(DRAWS)](rng, folder)


def sound(command: str, folder: Path, out: bool = True) -> list[str]:
    """A command line that works, and is quick."""
    if command in ("devices", "doctor"):
        return [command]
    small = [] if command == "forecast" else ["--height", "16", "--width", "32"]
    where = ["--out", str(folder / "out")] if out else []
    clip = str(write_clip(folder / "sound")) if command == "forecast" else "street:1"
    return [command, *([] if command == "demo" else [clip]), *small, *where]


def pick(rng: Rng, choices: Sequence[Any]) -> Any:
    return choices[int(rng.integers(len(choices)))]
