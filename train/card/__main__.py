"""Write a model's card: `python -m train.card RUN --results FOLDER --out docs/vest-s`.

All figures come from files: the run's log and last checkpoint, the prepared clips that it was trained on, and the
results.json of `train.evaluate`, which must be of the very file that the card is of. The author's words are in
train/card/card.md, a Jinja template. Written are README.md, curves.png, log.jsonl (thinned), config.yaml and the sheets
of the results.
"""

import dataclasses
import hashlib
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, Final

import tyro
import yaml
from huggingface_hub import ModelCard, ModelCardData

from train.card import images as card_images
from train.card.images import Rows
from train.card.tables import Weights, about_model, data_table, prepare_commands, result_tables, training_table
from train.command import ERRORS, failed, warnings_in_lines
from train.evaluation.options import Evaluation
from train.evaluation.protocols import PROTOCOLS
from train.run import checkpoint
from train.run.checkpoint import TrainingState
from train.run.report import LOG, read_log
from train.settings.config import Config, from_dict
from vestcl import interrupt
from vestcl.cli import command_line
from vestcl.io.atomic import read_bytes, write_bytes
from vestcl.models.checkpoint import read_checkpoint
from vestcl.models.shipped import find_model

#: Rows of the log that is kept next to the card: a curve of some hundred pixels has no use for more.
LOG_ROWS: Final = 300

#: What of a results.json a card is made of.
_RESULTS: Final = {
    "title": str, "models": dict, "settings": dict, "weights": dict, "machine": dict, "intervals": dict,
    "differences": dict, "clips": dict, "windows": list,
}  # fmt: skip

_TEMPLATE: Final = Path(__file__).with_name("card.md")

#: What huggingface.co shows of a model.
_ABOUT: Final = ModelCardData(
    license="apache-2.0", library_name="vestcl", tags=["video-prediction", "novel-view-synthesis", "driving"]
)

Results = list[tuple[Path, dict[str, Any]]]
"""Folders of `train.evaluate`, and their results.json."""


@dataclass(frozen=True)
class Card:
    """Write the card of a trained model."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    results: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """Folder of `train.evaluate`'s results; may be repeated. A folder's name names its sheets."""
    out: Path = Path("docs/vest-s")
    """The card's folder; its name is the model's."""
    checkpoint: Path | None = None
    """The file that is shipped; without it the EMA weights of the run's last checkpoint."""
    horizons: tuple[int, ...] = (1, 3, 5)
    """Steps that tables show, of those that were evaluated."""
    machine: str | None = None
    """What the run was made on; without it what it was evaluated on is listed, marked as such."""
    prepare: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A command that prepared data; may be repeated. Default: guessed from the clips."""


@interrupt.command
def main(arguments: Sequence[str] | None = None) -> int:
    """The command; what a user can correct is reported in one line, with exit code 2."""
    options = command_line.parsed(Card, "python -m train.card", __doc__, arguments)
    with warnings_in_lines():
        try:
            for path in write_card(options):
                print(path)
        except ERRORS as error:
            return failed(error)
    return 0


def write_card(options: Card) -> list[Path]:
    """Write the card's files; those that are there are replaced one by one.

    Args:
        options: where from and where to.

    Returns:
        The files.

    Raises:
        ValueError: a folder that is not a run, data that is not there any more, results of another file, or two folders
            of results of one name.
        CheckpointError: all of the run's checkpoints are damaged.
        FileNotFoundError: no such model.
    """
    state = checkpoint.load_latest(options.run)
    if state is None or not (options.run / LOG).is_file():
        raise ValueError(f"`run` must be a folder of train.fit, with a checkpoint and {LOG}, got {options.run}")
    rows = [row for row in read_log(options.run / LOG) if row["step"] <= state.step]  # a run may be in progress
    out = options.out
    if not rows:
        raise ValueError(f"`run` must have made steps that were logged, got none in {options.run / LOG}")
    weights = _weights(options.checkpoint or checkpoint.list_checkpoints(options.run)[0])
    results = _results(options, weights)
    texts = {
        "README.md": _text(options, state, rows, weights, results),
        "config.yaml": yaml.safe_dump(portable(state.config), sort_keys=False, width=120),
        LOG: "".join(json.dumps(row) + "\n" for row in thinned(rows)),
    }
    for name, text in texts.items():
        write_bytes(out / name, text.encode())
    card_images.draw_curves(out / "curves.png", rows)
    sheets = {out / name: source for name, source in _sheets(results).items()}
    for path, source in sheets.items():
        card_images.write_sheet(path, source)
    return [*(out / name for name in texts), out / "curves.png", *sheets]


def thinned(rows: Sequence[dict[str, Any]], most: int = LOG_ROWS) -> list[dict[str, Any]]:
    """Every n-th row and the last one, with the least n that leaves ``most`` or fewer.

    Args:
        rows: of a log.
        most: 2 or more.
    """
    every = max(-(-(len(rows) - 1) // (most - 1)), 1)
    return [row for index, row in enumerate(rows) if index % every == 0 or index == len(rows) - 1]


def portable(settings: Any) -> Any:
    """``settings`` with only the last part of every absolute path: this machine's folders are of no use elsewhere."""
    if isinstance(settings, dict):
        return {key: portable(value) for key, value in settings.items()}
    if isinstance(settings, list):
        return [portable(value) for value in settings]
    if isinstance(settings, str) and PurePath(settings).is_absolute():
        return PurePath(settings).name
    return settings


# ---------------------------------------------------------------- what the card is made of


def _weights(path: Path) -> Weights:
    file = find_model(path)
    content = read_bytes(file)
    model_config, state = read_checkpoint(file)
    return Weights(file.name, len(content), hashlib.sha256(content).hexdigest(), model_config, state)


def _results(options: Card, weights: Weights) -> Results:
    found: Results = []
    for folder in options.results:
        saved = _read_results(folder / "results.json")
        known = {model["sha256"] for model in saved["models"].values()}
        if weights.sha256 not in known:
            hashes = ", ".join(sorted(sha[:16] for sha in known)) or "no model"
            raise ValueError(f"`results` must be of the file {weights.sha256[:16]}, got {folder} of {hashes}")
        found.append((folder, saved))
    names = [folder.resolve().name for folder, _ in found]
    if len(set(names)) < len(names):
        raise ValueError(f"`results` must be folders of different names, got {', '.join(names)}")
    return found


def _read_results(path: Path) -> dict[str, Any]:
    try:
        saved = json.loads(read_bytes(path))
        fits = all(isinstance(saved[name], kind) for name, kind in _RESULTS.items())
        if fits and all(isinstance(model["sha256"], str) for model in saved["models"].values()):
            return dict(saved)
    except (json.JSONDecodeError, UnicodeDecodeError, LookupError, TypeError, AttributeError, RecursionError):
        pass
    raise ValueError(f"{path}: must be what train.evaluate writes, with {', '.join(_RESULTS)}; evaluate again")


def _text(options: Card, state: TrainingState, rows: Rows, weights: Weights, results: Results) -> str:
    """README.md: the author's words with what the files contain."""
    config, machine = from_dict(state.config), options.machine
    if machine is None and results:
        machine = f"{_machine(results[0][1]['machine'])} (of the evaluation)"
    versions = ", ".join(f"{name} {version}" for name, version in state.versions.items())
    sections = {
        "name": options.out.name,
        "about": _about(config, weights, state.step),
        "model": about_model(weights),
        "data": data_table(config),
        "training": training_table(config, rows, state.step, machine, versions),
        "figures": _figures(options, weights, results),
        "longest": str(max(_horizons(config))),
        "commands": _commands(options, config, weights, results),
    }
    return f"{ModelCard.from_template(_ABOUT, template_path=str(_TEMPLATE), **sections)}\n"


def _about(config: Config, weights: Weights, step: int) -> str:
    done = "" if step == config.steps else f" of {config.steps:,}; **the run is not finished**"
    return (
        f"`{config.model}`, trained in {step:,} steps{done}. The file has {weights.size / 1e6:.1f} MB and "
        f"{weights.parameters:,} parameters; its SHA-256 is `{weights.sha256}`."
    )


def _figures(options: Card, weights: Weights, results: Results) -> str:
    if not results:
        return "None yet."
    parts = []
    for folder, saved in results:
        method = next(name for name, model in saved["models"].items() if model["sha256"] == weights.sha256)
        tables = result_tables(saved, method, options.out.name, options.horizons)
        sheets = [f"![{word} window]({_sheet_name(folder, word)})" for word in _words(folder)]
        parts += [f"### {folder.resolve().name}: {saved['title']}", *tables]
        parts += ["Best, median and worst window:"] * bool(sheets) + sheets
    return "\n\n".join(parts)


def _commands(options: Card, config: Config, weights: Weights, results: Results) -> str:
    lines = [*(options.prepare or prepare_commands(config))]
    roots = [PurePath(root).name for root in config.data.train]
    folder = PurePath(portable(str(options.out)))
    lines.append(f"python -m train.fit {(folder / 'config.yaml').as_posix()} out=runs/{options.out.name} "
                 f"data.train='{json.dumps(roots)}'")  # fmt: skip
    lines += [_evaluate_command(saved, weights) for _, saved in results]
    words = "Folders are to be put in (`config.yaml` has their last parts). The commands in turn:"
    return "\n".join([words, "", "```sh", *lines, "```"])


def _evaluate_command(saved: dict[str, Any], weights: Weights) -> str:
    """The options set in results.json, without the defaults."""
    name, (height, width) = saved["settings"]["protocol"], saved["settings"]["size"]
    plain = PROTOCOLS[name]
    defaults = {field.name: field.default for field in dataclasses.fields(Evaluation)}
    defaults |= {"steps": plain.steps, "first": plain.first, "last": plain.last, "mode": weights.config.default_mode}
    defaults |= dict(zip(("height", "width"), plain.size, strict=True))
    folders = {name: saved["settings"].get(name) and name.upper() for name in ("data", "prepared")}
    settings = saved["settings"] | {"height": height, "width": width, **folders}
    words = ["python -m train.evaluate", name, f"--model {weights.name}"]
    for option, value in settings.items():
        given = tuple(value) if isinstance(value, list) else value
        if option in defaults and option != "protocol" and value is not None and given != defaults[option]:
            words.append(f"--{option.replace('_', '-')}" + ("" if value is True else f" {value}" if given is value else
                                          " " + " ".join(map(str, given))))  # fmt: skip
    measured = {"squeeze": "--squeeze WEIGHTS", "st_lpips": "--st-lpips"}
    return " ".join([*words, *(option for name, option in measured.items() if name in saved["weights"])])


def _machine(saved: dict[str, str]) -> str:
    return f"{saved['cores']} cores, {saved['processor']}, {saved['device'].split(' ', 1)[-1]}"


def _horizons(config: Config) -> list[int]:
    """Steps that some stage was shown as a target."""
    data = [config.data_of(stage) for stage in config.stages]
    return [k for each in data for k, weight in enumerate(each.horizons, 1) if weight > 0]


def _words(folder: Path) -> list[str]:
    return [word for word in ("best", "median", "worst") if (folder / f"sheet_{word}.png").is_file()]


def _sheet_name(folder: Path, word: str) -> str:
    return f"{folder.resolve().name}_{word}.jpg"


def _sheets(results: Results) -> dict[str, Path]:
    return {_sheet_name(folder, w): folder / f"sheet_{w}.png" for folder, _ in results for w in _words(folder)}


if __name__ == "__main__":
    sys.exit(main())
