"""A twentieth of the fuzzed scenes of tests/stress/fuzz_splat.py; and that they would find what is wrong."""

from typing import Any

import numpy as np
import pytest
import torch
from stress import fuzz_splat

from vestcl.ops.splat import splat


def test_a_twentieth_of_the_scenes() -> None:
    tally = fuzz_splat.run(share=0.05, seed=0)
    assert not tally.failures, "\n".join(tally.failures[: fuzz_splat.SHOWN_FAILURES])
    assert tally.scenes == fuzz_splat.SCENES // 20
    assert np.median(tally.bounds) < 3e-6, "of float32 images"


@pytest.mark.parametrize("wrong", ["image", "coverage", "gradients"])
def test_a_wrong_operator_is_found(monkeypatch: pytest.MonkeyPatch, wrong: str) -> None:
    """By one part in 100,000."""

    def slightly_wrong(features: torch.Tensor, **arguments: Any) -> tuple[torch.Tensor, torch.Tensor]:
        if wrong == "gradients":
            features = features + 1e-5 * (features - features.detach())
        image, coverage = splat(features=features, **arguments)
        if wrong == "coverage":
            return image, coverage * (1 + 1e-5)
        return image * (1 + 1e-5) if wrong == "image" else image, coverage

    monkeypatch.setattr(fuzz_splat, "splat", slightly_wrong)
    failures = fuzz_splat.run(share=0.001, seed=0).failures
    named = "features" if wrong == "gradients" else wrong
    assert sum(f", {named}[" in failure for failure in failures) >= 5


def test_the_reference_by_hand() -> None:
    """SPEC's oracle: 1 at the point's own pixel, 5/9 at the 4-neighbours, 1/9 at the diagonals; behind it, T b."""
    point = {
        "points_uv": np.full((1, 2), 2.5), "z": np.ones(1), "radii": np.full(1, 1.5), "opacities": np.ones(1),
        "features": np.full((1, 1), 2.0),
    }  # fmt: skip
    image, coverage = fuzz_splat.Cloud(point, 5, 5, 0.0).show(np.full(1, 10.0))
    wanted = np.zeros((5, 5))
    wanted[1:4, 1:4] = np.array([[1, 5, 1], [5, 9, 5], [1, 5, 1]]) / 9
    np.testing.assert_allclose(coverage.value.reshape(5, 5), wanted)
    np.testing.assert_allclose(image.value.reshape(5, 5), 2 * wanted + 10 * (1 - wanted))


def test_the_reference_by_finite_differences() -> None:
    """Its gradients are those of its own image and coverage."""
    rng = np.random.default_rng(0)
    count, height, width = 7, 3, 4
    cloud = {
        "points_uv": rng.uniform(0, 4, (count, 2)), "z": rng.uniform(1, 2, count), "radii": rng.uniform(1, 3, count),
        "opacities": rng.uniform(0, 1, count), "features": rng.normal(size=(count, 2)),
    }  # fmt: skip
    background, g, h = rng.normal(size=2), rng.normal(size=(height * width, 2)), rng.normal(size=height * width)

    def loss(**changed: np.ndarray) -> float:
        inputs = {**cloud, "backgrounds": background, **changed}
        image, coverage = fuzz_splat.Cloud(inputs, height, width, 0.05).show(inputs["backgrounds"])
        return float((image.value * g).sum() + (coverage.value * h).sum())

    grads = fuzz_splat.Cloud(cloud, height, width, 0.05).gradients(background, g, h)
    for name, value in {**{n: cloud[n] for n in fuzz_splat.INPUTS[:4]}, "backgrounds": background}.items():
        for place in np.ndindex(value.shape):
            step = np.zeros_like(value)
            step[place] = 1e-6
            slope = (loss(**{name: value + step}) - loss(**{name: value - step})) / 2e-6
            assert grads[name].value[place] == pytest.approx(slope, rel=1e-6, abs=1e-7), f"grad_{name}{place}"
