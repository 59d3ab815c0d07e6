"""The tables of the documentation, each from a JSON file that a command wrote: `make tables`.

A page has a table between `<!-- table: NAME -->` and `<!-- /table -->`; `TABLES` lists the names. What is between the
markers is replaced, all else stays.

    python docs/tables.py                    write the tables of all pages
    python docs/tables.py --check            exit status 1 if a page differs from the files
    python docs/tables.py --keep FILE NAME   copy a bench's JSON to docs/results/NAME.json, paths reduced to names
"""

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import bench_rows
import rows
from rows import Row

ROOT: Final = Path(__file__).resolve().parents[1]
DOCS: Final = ROOT / "docs"

#: Keys of benches' files that are not kept: their means per clip are in "windows", too.
_DROPPED: Final = ("clips",)

#: Columns of text, to the left.
_LEFT: Final = ("method", "settings")

_BLOCK: Final = re.compile(r"(?P<start><!-- table: (?P<name>[\w-]+) -->\n).*?(?P<end><!-- /table -->)", re.DOTALL)


@dataclass(frozen=True)
class Source:
    """A JSON file of a bench, and the command that writes it."""

    path: str
    """From the repository's root."""
    command: str

    def read(self) -> dict[str, Any]:
        """The file's content.

        Raises:
            ValueError: no such file, or no JSON object.
        """
        path = ROOT / self.path
        if not path.is_file():
            raise ValueError(f"{self.path}: no such file; `{self.command}` writes it")
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{self.path}: no JSON: {error}") from error
        if not isinstance(content, dict):
            raise ValueError(f"{self.path}: must be a JSON object, got {type(content).__name__}")
        return content


@dataclass(frozen=True)
class Table:
    """A table of the documentation."""

    sources: tuple[Source, ...]
    cells: Callable[..., Iterator[Row]]
    """Of the files' contents: the heading, then the rows."""

    def markdown(self) -> str:
        """The table, and a line with the commands and when and where they ran."""
        contents = [source.read() for source in self.sources]
        heading, *body = self.cells(*contents)
        lines = [
            _pipes(heading),
            _pipes(["---", *("---" if cell in _LEFT else "---:" for cell in heading[1:])]),
            *map(_pipes, body),
            "",
        ]
        for source, content in zip(self.sources, contents, strict=True):
            lines += [f"<small>`{source.command}`; {_origin(content)}.</small>", ""]
        return "\n".join(lines[:-1]) + "\n"


# ---------------------------------------------------------------- the tables

FORECAST: Final = Source(
    "docs/results/forecast.json",
    "vestcl bench forecast CLIP ... --windows docs/windows.json --work-width 0 --st-lpips FILE",
)
WORKING: Final = Source(
    "docs/results/work_width.json",
    "vestcl bench forecast CLIP ... --windows docs/windows_8.json --model vest-s --peer FILE --st-lpips FILE",
)
STREETS: Final = Source(
    "docs/results/streets.json",
    "vestcl bench forecast street: --pool --first 2 --last 2 --model vest-s --st-lpips FILE",
)
ABLATION: Final = Source(
    "docs/results/ablation.json",
    "python -m train.evaluate street --height 128 --width 416 --seeds 1100 1119 --st-lpips FILE",
)
PEER: Final = Source(
    "docs/results/peer_streets.json", "python -m train.evaluate street --model vest-s --peer FILE --st-lpips FILE"
)
SPLAT: Final = Source("docs/results/splat.json", "vestcl bench splat")
STABILITY: Final = Source("docs/results/stability.json", "vestcl bench stability")
CAMERA: Final = Source("docs/results/camera.json", "vestcl bench camera 00.txt 06.txt")
INPAINTING: Final = Source("docs/results/inpaint.json", "vestcl bench inpaint")
MEMORY: Final = Source(
    "docs/results/memory.json", "vestcl bench inpaint --clips CLIP ... --windows 4 --memory 0 3 10 --st-lpips FILE"
)
NETWORK: Final = Source("docs/results/network.json", "vestcl bench network")
NETWORK_PAPER: Final = Source(
    "docs/results/network_paper.json", "vestcl bench network --model vest-paper+colour --runs 2 --no-training"
)
TRAIN_STEP: Final = Source("docs/results/train_step.json", "vestcl bench train-step")
FRONT: Final = Source("docs/results/front.json", "vestcl bench front CLIP ... --windows 1 --st-lpips FILE")
FORECAST_TIMES: Final = Source(
    "docs/results/forecast_times.json", "python docs/forecast_times.py CLIP ... --work-width 0 960 640 --runs 1"
)
PARETO: Final = Source("docs/time_against_error/pareto.json", "vestcl bench pareto")
PIPELINE: Final = Source("docs/time_against_error/pipeline.json", "vestcl bench pipeline")

TABLES: Final = {
    "accuracy": Table((STREETS, FORECAST), rows.short),
    "forecast-source": Table((FORECAST,), rows.clips("source")),
    "forecast-right": Table((FORECAST,), rows.clips("right")),
    "work-width": Table((WORKING, FORECAST), rows.work_widths),
    "streets-source": Table((STREETS,), rows.methods("source")),
    "streets-right": Table((STREETS,), rows.methods("right")),
    "streets-facts": Table((STREETS,), rows.facts),
    "peer-streets": Table((PEER,), rows.evaluated),
    "ablation": Table((ABLATION,), rows.ablation),
    "speed": Table((PARETO,), rows.speed),
    "presets": Table((PARETO,), rows.presets),
    "camera": Table((CAMERA,), bench_rows.camera),
    "inpainting": Table((INPAINTING,), bench_rows.inpainting),
    "memory": Table((MEMORY,), bench_rows.memory),
    "network": Table((NETWORK, NETWORK_PAPER), bench_rows.network),
    "front": Table((FRONT,), bench_rows.front),
    "forecast-times": Table((FORECAST_TIMES,), bench_rows.forecast_times),
    "train-step": Table((TRAIN_STEP,), bench_rows.training),
    "splat": Table((SPLAT,), rows.splatting),
    "opacities": Table((STABILITY,), rows.opacities),
    "skipping": Table((PIPELINE,), rows.skipping),
}


def pages() -> list[Path]:
    """README.md and all Markdown of docs/."""
    return [ROOT / "README.md", *sorted(path for path in DOCS.rglob("*.md") if "_build" not in path.parts)]


def filled(text: str) -> str:
    """A page's text with its tables from the files.

    Raises:
        ValueError: a table that `TABLES` does not have, or that has no file.
    """

    def replaced(match: re.Match[str]) -> str:
        name = match["name"]
        if name not in TABLES:
            raise ValueError(f"table {name!r} must be one of {', '.join(TABLES)}")
        return f"{match['start']}{TABLES[name].markdown()}{match['end']}"

    return _BLOCK.sub(replaced, text)


def stale() -> list[Path]:
    """Pages whose tables differ from the files."""
    texts = ((page, page.read_text(encoding="utf-8")) for page in pages())
    return [page for page, text in texts if filled(text) != text]


def keep(file: Path, name: str) -> Path:
    """Copy a bench's JSON to docs/results; of paths, which are of one machine, only names stay.

    Raises:
        ValueError: the file can't be read or is no JSON.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{file}: can't be read as JSON: {error}") from error
    kept = DOCS / "results" / f"{name}.json"
    kept.write_text(json.dumps(_named(content), separators=(",", ":")) + "\n", encoding="utf-8")
    return kept


def main() -> int:
    """Write, check or keep; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit status 1 if a page is stale")
    parser.add_argument("--keep", nargs=2, metavar=("FILE", "NAME"), help="copy a bench's JSON to docs/results")
    options = parser.parse_args()
    try:
        if options.keep:
            print(f"wrote {keep(Path(options.keep[0]), options.keep[1]).relative_to(ROOT)}")
        found = stale()
        for page in found:
            print(f"{page.relative_to(ROOT)}: {'is stale, run `make tables`' if options.check else 'written'}")
            if not options.check:
                page.write_text(filled(page.read_text(encoding="utf-8")), encoding="utf-8")
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return int(options.check and bool(found))


def _named(value: Any) -> Any:
    if isinstance(value, dict):
        return {_named(key): _named(item) for key, item in value.items() if key not in _DROPPED}
    if isinstance(value, list):
        return [_named(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.6g}")
    return Path(value).name if isinstance(value, str) and value.startswith("/") else value


def _origin(content: Mapping[str, Any]) -> str:
    """ "vestcl 0.1.0, 2026-12-01, AMD EPYC, 2 cores"."""
    machine = content["machine"] if "machine" in content else content["devices"][0]["machine"]
    return f"vestcl {machine['vestcl']}, {machine['date'][:10]}, {machine['processor']}, {machine['cores']} cores"


def _pipes(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    sys.exit(main())
