"""`python -m train.evaluate --model NAME=FILE`: what tables call a model."""

from pathlib import Path

import pytest
from test_train_evaluate import STREETS, model_file, run

from train.evaluation.options import Evaluation, models_of
from vestcl.models import shipped


def named(*given: str) -> dict[str, Path]:
    return models_of(Evaluation("street", model=tuple(map(Path, given))))


def test_models_have_the_names_that_are_given(tmp_path: Path) -> None:
    """Two runs of one stem; a folder of a checkpoint; a file with = in its name."""
    odd = model_file(tmp_path / "a=b.safetensors", 1)
    folder = tmp_path / "step-00000002"
    folder.mkdir()
    model_file(folder / "ema.safetensors", 1)
    assert named("first=a/x.safetensors", "zweiter Lauf=b/x.safetensors", str(odd), str(folder), "vest-s") == {
        "first": Path("a/x.safetensors"),
        "zweiter Lauf": Path("b/x.safetensors"),
        "a=b": odd,
        "step-00000002": folder / "ema.safetensors",
        "vest-s": shipped.find_model("vest-s"),
    }


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("x=a.safetensors", "x=b.safetensors"), "got x again; NAME=FILE gives one another name"),
        (("x=a.safetensors", "x.safetensors"), "got x again"),
        (("geometric=a.safetensors",), "got geometric again"),
        (("optical flow=a.safetensors",), "got optical flow again"),
        (("=a.safetensors",), "must have a name of letters, digits"),
        (("a,b=a.safetensors",), "must have a name of letters, digits"),
        (("x=",), "must be FILE or NAME=FILE, got 'x='"),
    ],
)
def test_names_that_cannot_be(given: tuple[str, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        named(*given)


def test_a_named_model_is_in_the_tables(tmp_path: Path) -> None:
    settings = {**STREETS, "seeds": (3, 3), "steps": 1, "horizons": (1,), "sheets": False, "out": tmp_path / "out"}
    reported = run(**settings, model=(Path(f"mine={model_file(tmp_path / 'x.safetensors', 1)}"),))
    assert "mine" in reported["summary"]["source"] and set(reported["models"]) == {"mine"}
