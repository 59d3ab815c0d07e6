"""Random small scenes through `splat`, forward and all gradients, against a reference of its own in float64 NumPy.

    python tests/stress/fuzz_splat.py [--share 1.0] [--seed 0] [--scene 123] [--mapping pixel]

The reference composites densely, every point at every pixel, and carries a bound along of what the operator's
roundings may change: each operation of its formula adds its own rounding to what its operands bring. The unit is the
dtype's eps: half of it for the operator, which rounds to nearest, and half for the reference in float64. Two places
have no such bound. At a footprint's rim (d2 = r2 within the bound) a fragment may be there or not: its alpha is 0
within the bound either way, its gradient counts as error in full. Where T is min_transmittance within the bound, what
lies behind may show or not: that pixel is left out of the comparison, and of the loss.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
import torch

from vestcl import opencl
from vestcl.ops.splat import splat

SCENES: Final = 20_000
#: Programs that a full run builds (about a second each); scene i takes program i % PROGRAMS.
PROGRAMS: Final = 64
GEOMETRY: Final = ("points_uv", "radii", "opacities")
INPUTS: Final = (*GEOMETRY, "features", "backgrounds")
#: What is below it underflows in products that are rounded to the dtype.
UNDERFLOW: Final = {"float32": 1e-30, "float64": 1e-290}
#: Positions and radii that are multiples of it, and up to EXACT_TO, have d2 and r2 without rounding.
EXACT: Final = 1 / 16
EXACT_TO: Final = 100.0
TRUNCATIONS: Final = (1e-4, 0.01, 0.1, 0.3, 0.5, 0.9)
SHOWN_FAILURES: Final = 10
MAPPINGS: Final = ("tile", "pixel")

Array = np.ndarray[Any, Any]


class Bounded(NamedTuple):
    """A value in float64, and how far from it the operator's may be."""

    value: Array
    error: Array


@dataclass(frozen=True)
class Program:
    """What kernels are built for."""

    dtype: str
    mapping: str
    truncate: bool
    channels: int
    asked: tuple[str, ...] = INPUTS
    backgrounds: bool = True
    coverage: bool = True
    """Whether the loss looks at the coverage."""


@dataclass
class Tally:
    """What a run found."""

    scenes: int = 0
    fragments: int = 0
    ambiguous_pixels: int = 0
    worst: float = 0.0
    """The largest error as a part of its bound ..."""
    worst_at: str = ""
    """... and where it is."""
    bounds: list[float] = field(default_factory=list)
    """Of each float32 scene's image: its median bound as a part of its largest value."""
    failures: list[str] = field(default_factory=list)


# ---------------------------------------------------------------- scenes


def programs(count: int, rng: np.random.Generator, mappings: Sequence[str] = MAPPINGS) -> list[Program]:
    """The first ones are those that the operator's own tests build as well."""
    dtypes = ("float32", "float64") if opencl.current().info.float64 else ("float32",)
    plain = [
        Program(dtype, mapping, truncate, 3 if truncate else 5)
        for dtype in dtypes for mapping in mappings for truncate in (False, True)
    ]  # fmt: skip
    chosen = list(plain)
    while len(chosen) < count:
        asked = tuple(name for name in INPUTS if rng.random() < 0.6) or (str(rng.choice(INPUTS)),)
        has_backgrounds = bool(rng.random() < 0.7)
        asked = asked if has_backgrounds else tuple(n for n in asked if n != "backgrounds") or GEOMETRY
        base = plain[len(chosen) % len(plain)]
        channels, coverage = int(rng.integers(1, 21)), bool(rng.random() < 0.6)
        chosen.append(Program(base.dtype, base.mapping, base.truncate, channels, asked, has_backgrounds, coverage))
    return chosen[:count]


def log_integer(rng: np.random.Generator, low: int, high: int) -> int:
    """Small ones as often as large ones."""
    return min(high, int(np.exp(rng.uniform(np.log(low), np.log(high + 1)))))


def mixed(rng: np.random.Generator, count: int, *kinds: Array | float) -> Array:
    """For each point one of the kinds, in proportions that differ from scene to scene."""
    parts = rng.dirichlet(np.full(len(kinds), 0.5))
    which = rng.choice(len(kinds), size=count, p=parts)
    columns = [np.broadcast_to(kind, (count,)) for kind in kinds]
    return np.choose(which, columns) if count else np.zeros(0)


def coordinates(rng: np.random.Generator, count: int, size: int) -> Array:
    anywhere = rng.uniform(-4, size + 4, count)
    sixteenths = np.round(anywhere / EXACT) * EXACT
    centres = rng.integers(0, size, count) + 0.5
    return mixed(rng, count, anywhere, anywhere, centres, sixteenths, rng.uniform(-4000, 4000, count), size // 2 + 0.5)


def make_scene(program: Program, rng: np.random.Generator) -> dict[str, Any]:
    """Arguments of `splat` as NumPy arrays of the program's dtype, clouds packed one after another."""
    dtype = np.dtype(program.dtype)
    height, width = log_integer(rng, 1, 40), log_integer(rng, 1, 40)
    batch = int(rng.choice(4, p=(0.02, 0.68, 0.2, 0.1)))
    most = 600 if rng.random() < 0.01 else 200
    counts = np.array([log_integer(rng, 1, most + 1) - 1 for _ in range(batch)], np.int64)
    packed = bool(rng.random() < 0.4)
    counts = counts if packed else np.full(batch, counts.max(initial=0))
    n = int(counts.sum())
    near = dtype.type(0.1)
    r = rng.uniform(0.3, 4, n)
    radii = mixed(
        rng, n, r, r, np.round(r / EXACT) * EXACT, 1.5, 8 * r, 200 * r, 1000 * r, 0.05 * r,
        rng.choice([0, -1, 1e-25, 1e-17, 1e8, 1e18, 1e200], n),
    )  # fmt: skip
    z = mixed(rng, n, rng.uniform(0.1, 20, n), rng.integers(1, 4, n), 1.0, rng.choice([-1, 0, near, 0.0999], n))
    wild = rng.uniform(-0.5, 1.5, n) if rng.random() < 0.05 else rng.uniform(0, 1, n)
    features = rng.normal(size=(n, program.channels)) * rng.choice([1, 1, 1, 1e3, 1e-3])
    scene = {
        "points_uv": np.stack([coordinates(rng, n, size) for size in (width, height)], axis=-1),
        "z": z,
        "radii": radii,
        "opacities": mixed(rng, n, wild, wild, 1.0, 0.0, rng.uniform(0.95, 1, n)),
        "features": features,
        "backgrounds": rng.normal(size=(batch, program.channels)) if program.backgrounds else None,
    }
    with np.errstate(over="ignore"):
        scene = {name: None if array is None else array.astype(dtype) for name, array in scene.items()}
    if rng.random() < 0.15:
        for name in ("points_uv", "z", "radii", "opacities", "features"):
            bad = rng.random(scene[name].shape) < 0.02
            scene[name][bad] = rng.choice([np.nan, np.inf, -np.inf], int(bad.sum()))
    limit = float(rng.choice(TRUNCATIONS)) if program.truncate else 0.0
    starts = np.concatenate([[0], np.cumsum(counts)])
    return scene | {
        "height": height, "width": width, "min_transmittance": limit, "cloud_starts": starts, "packed": packed,
    }  # fmt: skip


# ---------------------------------------------------------------- the reference


def drawable(cloud: dict[str, Array]) -> Array:
    """Indices of the points that can make fragments, in the order (z, index)."""
    z, radii = cloud["z"], cloud["radii"]
    with np.errstate(all="ignore"):
        r2 = radii * radii  # in the dtype
        numbers = [cloud["points_uv"], z[:, None], r2[:, None], cloud["opacities"][:, None], cloud["features"]]
        finite = np.isfinite(np.concatenate(numbers, axis=1)).all(axis=1)
        seen = finite & (z >= z.dtype.type(0.1)) & (radii > 0) & (r2 >= np.finfo(r2.dtype).tiny)
    index = np.flatnonzero(seen)
    return index[np.argsort(z[index], kind="stable")]


class Cloud:
    """One image: alphas and transmittances of every point at every pixel, [N, P] and [N + 1, P], front to back."""

    def __init__(self, cloud: dict[str, Array], height: int, width: int, limit: float) -> None:
        self.count, self.index = len(cloud["z"]), drawable(cloud)
        self.eps = float(np.finfo(cloud["z"].dtype).eps)
        uv, self.r, self.o, self.f = (cloud[n][self.index].astype(float) for n in (*GEOMETRY, "features"))
        self.r, self.o = self.r[:, None], self.o[:, None]
        self.r2 = self.r * self.r
        y, x = (axis.ravel() + 0.5 for axis in np.mgrid[:height, :width])
        self.dx, self.dy = x - uv[:, :1], y - uv[:, 1:]
        sixteenths = (uv % EXACT == 0) & (np.abs(uv) <= EXACT_TO)
        roundings = np.where(sixteenths, 0, 2 * self.eps * (np.abs(uv) + 64))  # of u minus the tile's corner, minus 1/2
        self.dx_error, self.dy_error = roundings[:, :1], roundings[:, 1:]
        self._measure(sixteenths.all(axis=1, keepdims=True))
        self._composite(limit)

    def _measure(self, exact: Array) -> None:
        """d2, which fragments there are, and their alphas."""
        eps, r2 = self.eps, self.r2
        self.d2 = self.dx**2 + self.dy**2
        rounding = np.where(exact & (np.abs(self.dx) <= 64) & (np.abs(self.dy) <= 64), 0, 3 * eps * self.d2)
        products = 2 * np.abs(self.dx) * self.dx_error + 2 * np.abs(self.dy) * self.dy_error
        self.d2_error = products + self.dx_error**2 + self.dy_error**2 + rounding
        self.r2_error = np.where((self.r % EXACT == 0) & (self.r <= EXACT_TO), 0, eps * r2)
        margin = self.d2_error + self.r2_error
        self.near = self.d2 < r2 + margin
        self.rim = (np.abs(self.d2 - r2) <= margin) & (margin > 0)
        self.there = self.d2 < r2
        self.alpha = np.where(self.there, self.o * (1 - self.d2 / r2), 0)
        part = self.d2 / r2
        error = (self.d2_error + part * self.r2_error) / r2 + eps * (5 * part + 1)  # OpenCL's division: 2.5 eps
        self.alpha_error = np.where(self.near, np.abs(self.o) * error, 0)

    def _composite(self, limit: float) -> None:
        """Transmittances [N + 1, P]; where T is below the limit there are no more fragments."""
        count, pixels = self.alpha.shape
        self.t, self.t_error = np.ones((count + 1, pixels)), np.zeros((count + 1, pixels))
        self.unclear = np.zeros(pixels, bool)
        for i in range(count):
            t, error = self.t[i], self.t_error[i]
            if limit > 0:
                self.unclear |= self.near[i] & (np.abs(t - limit) <= error)
                for array in (self.alpha, self.alpha_error, self.near, self.rim, self.there):
                    array[i, t < limit] = 0
            rest, alpha_error = 1 - self.alpha[i], self.alpha_error[i]
            self.t[i + 1] = t * rest
            rest = np.abs(rest)
            self.t_error[i + 1] = error * (rest + alpha_error) + np.abs(t) * (alpha_error + 2 * self.eps * rest)
        before, before_error = self.t[:-1], self.t_error[:-1]
        self.weight = self.alpha * before
        moved = np.abs(self.alpha) * before_error + (np.abs(before) + before_error) * self.alpha_error
        self.weight_error = moved + self.eps * np.abs(self.weight)

    def show(self, background: Array) -> tuple[Bounded, Bounded]:
        """image [P, C] and coverage [P]."""
        last, last_error = self.t[-1], self.t_error[-1]
        behind = last[:, None] * background
        terms = np.abs(self.weight).T @ np.abs(self.f)
        error = self.weight_error.T @ np.abs(self.f) + last_error[:, None] * np.abs(background)
        error += self.eps * ((self.near.sum(axis=0)[:, None] + 2) * terms + 2 * np.abs(behind))
        return Bounded(self.weight.T @ self.f + behind, error), Bounded(
            1 - last, last_error + self.eps * np.abs(1 - last)
        )

    def gradients(self, background: Array, g: Array, h: Array) -> dict[str, Bounded]:
        """Of sum(g image) + sum(h coverage), with g [P, C] and h [P]."""
        da = self._alpha_gradients(background, g, h)
        count = self.near.sum(axis=1, keepdims=True) + 3
        last, last_error = self.t[-1], self.t_error[-1]
        pixels = len(last) + 2
        grads = {
            "features": Bounded(
                self.weight @ g, self.weight_error @ np.abs(g) + count * self.eps * (np.abs(self.weight) @ np.abs(g))
            ),
            "backgrounds": Bounded(
                last @ g, last_error @ np.abs(g) + pixels * self.eps * (np.abs(last) @ np.abs(g))
            ),
        }  # fmt: skip
        sums = {
            name: self._sum(da, factor, error, count)
            for name, factor, error in (
                ("u", self.dx, self.dx_error), ("v", self.dy, self.dy_error), ("d2", self.d2, self.d2_error),
                ("1", np.ones_like(self.d2), np.zeros(1)),
            )
        }  # fmt: skip
        slope = 2 * self.o / self.r2
        u, v = (slope * sums[name] for name in "uv")
        radii = slope / self.r * sums["d2"]
        single, shrunk = sums["1"], sums["d2"] / self.r2
        opacities = np.stack([single[0] - shrunk[0], single[1] + shrunk[1]])
        grads["points_uv"] = Bounded(np.hstack([u[0], v[0]]), np.abs(np.hstack([u[1], v[1]])))
        grads["radii"] = Bounded(radii[0, :, 0], np.abs(radii[1, :, 0]))
        grads["opacities"] = Bounded(opacities[0, :, 0], opacities[1, :, 0])
        return {name: grad if name == "backgrounds" else self._scatter(grad) for name, grad in grads.items()}

    def _alpha_gradients(self, background: Array, g: Array, h: Array) -> Bounded:
        """dL/da_i = T_i (f_i.g - A_(i+1)), traversing A_i = a_i (f_i.g) + (1 - a_i) A_(i+1) from the back."""
        eps, roundings = self.eps, g.shape[1] + 2
        fg, fg_error = self.f @ g.T, roundings * self.eps * (np.abs(self.f) @ np.abs(g).T)
        rest, shown = 1 - self.alpha, self.alpha * fg
        # error_i = fixed + grown error_(i+1) + moved |A_(i+1)|
        fixed = np.abs(self.alpha) * fg_error + self.alpha_error * (np.abs(fg) + fg_error) + 3 * eps * np.abs(shown)
        grown, moved = np.abs(rest) + self.alpha_error, self.alpha_error + 3 * eps * np.abs(rest)
        behind, behind_error = np.empty_like(rest), np.empty_like(rest)
        a = g @ background - h
        error = roundings * eps * (np.abs(g) @ np.abs(background) + np.abs(h))
        for i in range(len(rest) - 1, -1, -1):
            behind[i], behind_error[i] = a, error
            error = fixed[i] + grown[i] * error + moved[i] * np.abs(a)
            a = shown[i] + rest[i] * a
        t, t_error, less = np.abs(self.t[:-1]), self.t_error[:-1], fg - behind
        grads = self.t[:-1] * less
        less_error = fg_error + behind_error + eps * np.abs(less)
        errors = (t + t_error) * less_error + t_error * np.abs(less) + (eps + self.rim) * np.abs(grads)
        return Bounded(np.where(self.there, grads, 0), np.where(self.near, errors, 0))

    def _sum(self, da: Bounded, factor: Array, factor_error: Array, count: Array) -> Array:
        """sum of da * factor over the pixels, and its error with that of the few products after it: [2, N, 1]."""
        terms = np.abs(da.value * factor)
        error = da.error * (np.abs(factor) + factor_error) + np.abs(da.value) * factor_error
        error = error.sum(axis=1, keepdims=True) + (count + 8) * self.eps * terms.sum(axis=1, keepdims=True)
        return np.stack([(da.value * factor).sum(axis=1, keepdims=True), error])

    def _scatter(self, grad: Bounded) -> Bounded:
        """From the points that can make fragments to all of them: the others' gradients are 0."""
        full = Bounded(*(np.zeros((self.count, *a.shape[1:])) for a in grad))
        for whole, part in zip(full, grad, strict=True):
            whole[self.index] = part
        return full


# ---------------------------------------------------------------- comparison


def clouds_of(scene: dict[str, Any]) -> list[Cloud]:
    dtype = scene["z"].dtype.type
    starts, limit = scene["cloud_starts"], float(dtype(scene["min_transmittance"]))
    arrays = {name: scene[name] for name in ("points_uv", "z", "radii", "opacities", "features")}
    return [
        Cloud({n: a[begin:end] for n, a in arrays.items()}, scene["height"], scene["width"], limit)
        for begin, end in pairwise(starts)
    ]


def run_operator(scene: dict[str, Any], program: Program, g: Array, h: Array) -> tuple[list[Array], dict[str, Array]]:
    """Image [B, P, C] and coverage [B, P], and the gradients that are asked for, of packed clouds."""
    batch, points = len(scene["cloud_starts"]) - 1, len(scene["z"])
    lead = () if scene["packed"] else (batch, points // max(batch, 1))
    inputs = {n: torch.from_numpy(scene[n]) for n in ("z", *INPUTS) if scene[n] is not None}
    given = {
        n: value.reshape(*(lead or value.shape[:1]), *value.shape[1:]) if n != "backgrounds" else value
        for n, value in inputs.items()
    }
    asked = [given[name].requires_grad_() for name in program.asked]
    sizes = {name: scene[name] for name in ("height", "width", "min_transmittance")}
    with opencl.use(mapping=program.mapping):
        outputs = splat(**given, **sizes, cloud_starts=torch.from_numpy(scene["cloud_starts"]) if not lead else None)
    shown = [output.detach().flatten(2).mT.numpy() for output in outputs]
    shape = (batch, scene["height"], scene["width"])
    channels_last = [torch.from_numpy(a.astype(program.dtype)).reshape(*shape, a.shape[2]) for a in (g, h[..., None])]
    weights = [w.permute(0, 3, 1, 2) for w in channels_last]
    if points % 2:
        weights = [weight.contiguous() for weight in weights]
    looked_at = 2 if program.coverage else 1
    grads = torch.autograd.grad(outputs[:looked_at], asked, weights[:looked_at])
    flat = {name: grad.numpy().reshape(scene[name].shape) for name, grad in zip(program.asked, grads, strict=True)}
    return [shown[0], shown[1][..., 0]], flat


def check_scene(index: int, seed: int, program: Program, tally: Tally) -> None:
    rng = np.random.default_rng([seed, index])
    scene = make_scene(program, rng)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore", under="ignore"):
        clouds = clouds_of(scene)
        batch, pixels = len(clouds), scene["height"] * scene["width"]
        clear = ~np.array([cloud.unclear for cloud in clouds], bool).reshape(batch, pixels)
        g = (rng.normal(size=(batch, pixels, program.channels)) * clear[..., None]).astype(program.dtype).astype(float)
        h = (rng.normal(size=(batch, pixels)) * clear * program.coverage).astype(program.dtype).astype(float)
        backgrounds = scene["backgrounds"] if program.backgrounds else np.zeros((batch, program.channels))
        wanted: dict[str, list[Bounded]] = {name: [] for name in ("image", "coverage", *INPUTS)}
        for b, cloud in enumerate(clouds):
            background = backgrounds[b].astype(float)
            for name, shown in zip(("image", "coverage"), cloud.show(background), strict=True):
                wanted[name].append(shown)
            for name, grad in cloud.gradients(background, g[b], h[b]).items():
                wanted[name].append(grad)
    outputs, grads = run_operator(scene, program, g, h)
    for name, got in {"image": outputs[0], "coverage": outputs[1], **grads}.items():
        join = np.stack if name in ("image", "coverage", "backgrounds") else np.concatenate
        value, error = (join([pair[k] for pair in wanted[name]]) if clouds else got for k in (0, 1))
        shown = clear if name in ("image", "coverage") else np.ones(len(got), bool)
        compare(f"scene {index}, {name}", got[shown], Bounded(value[shown], error[shown]), program, tally)
    tally.scenes += 1
    tally.fragments += sum(int(cloud.there.sum()) for cloud in clouds)
    tally.ambiguous_pixels += int((~clear).sum())
    if clear.any() and program.dtype == "float32":
        image = Bounded(*(np.stack([pair[k] for pair in wanted["image"]])[clear] for k in (0, 1)))
        tally.bounds.append(float(np.median(image.error) / max(np.abs(image.value).max(), 1e-3)))


def compare(what: str, got: Array, wanted: Bounded, program: Program, tally: Tally) -> None:
    """Record in ``tally`` the largest error as a part of its bound, and a failure where it is more than 1."""
    if got.size == 0:
        return
    error = np.abs(got - wanted.value)
    part = error / (wanted.error + UNDERFLOW[program.dtype])
    part[~np.isfinite(got)] = np.inf
    assert not np.isnan(wanted.error).any(), f"{what}: no bound"
    worst = np.unravel_index(np.argmax(part), part.shape)
    where = f"{what}{[int(i) for i in worst]}"
    if part[worst] > tally.worst:
        tally.worst, tally.worst_at = float(part[worst]), where
    if not part[worst] <= 1:
        values = f"{got[worst]:.9g}, not {wanted.value[worst]:.9g} within {wanted.error[worst]:.1e}"
        tally.failures.append(f"{where} is {values} ({program})")


def run(share: float, seed: int, only: int | None = None, mappings: Sequence[str] = MAPPINGS) -> Tally:
    """Check ``share`` of the scenes, or only scene ``only`` of them."""
    count = round(SCENES * share)
    chosen = programs(max(8, round(PROGRAMS * share)), np.random.default_rng(seed), mappings)
    tally = Tally()
    for index in range(count) if only is None else [only]:
        check_scene(index, seed, chosen[index % len(chosen)], tally)
    return tally


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--share", type=float, default=1.0, help=f"part of the {SCENES} scenes (default: 1)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scene", type=int, help="check this scene only")
    parser.add_argument("--mapping", choices=MAPPINGS, help="of the kernels, as in vestcl.use (default: both)")
    options = parser.parse_args()
    started = time.monotonic()
    mappings = (options.mapping,) if options.mapping else MAPPINGS
    tally = run(options.share, options.seed, options.scene, mappings)
    median = np.median(tally.bounds) if tally.bounds else 0.0
    print(
        f"fuzz_splat: {tally.scenes} scenes, {tally.fragments} fragments, {len(tally.failures)} failures in "
        f"{time.monotonic() - started:.0f} s; the largest error is {tally.worst:.2g} of its bound "
        f"({tally.worst_at}), which for float32 images is {median:.1e} in the median; "
        f"{tally.ambiguous_pixels} ambiguous pixels left out"
    )
    for failure in tally.failures[:SHOWN_FAILURES]:
        print(f"  {failure}")
    if tally.failures:
        mapping = f" --mapping {options.mapping}" if options.mapping else ""
        print(f"Repeat one with --share {options.share} --seed {options.seed}{mapping} --scene N")
    return 1 if tally.failures else 0


if __name__ == "__main__":
    sys.exit(main())
