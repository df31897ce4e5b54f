"""What a training run leaves behind: one results file, a model card, and a summary over a sweep."""

from __future__ import annotations

import csv
import json
import re
import shutil
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import torch
from kornia.core.exceptions import BaseError

from kornia_pnpnet.core.checks import check_whole
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.files import atomic_open
from kornia_pnpnet.core.schema import (
    RATE,
    is_count,
    is_flag,
    is_mapping_or_none,
    is_number,
    is_text,
    is_text_or_none,
    misfits,
    read_column,
    read_json,
    read_rows,
)
from kornia_pnpnet.data import OutlierMix
from kornia_pnpnet.metrics import pose_errors, success, success_rate
from kornia_pnpnet.pretrained import CONFIG_NAME, WEIGHTS_NAME, find_weights
from kornia_pnpnet.solver import PnPNet
from kornia_pnpnet.training.checkpoint import HISTORY_NAME, leaves
from kornia_pnpnet.training.loop import FitReport
from kornia_pnpnet.types import Problems

__all__ = [
    "collect_weights",
    "find_results",
    "load_run",
    "run_results",
    "summarize_runs",
    "write_json",
    "write_model_card",
]

RESULTS_NAME = "results.json"
_CARD_NAME = "README.md"
_LEARNED = "step", "damping", "robustness"


# What readers ask of the results of a run, and of those of the run before it, see `misfits`.
_STARTS = {"starts": is_count, "samples": is_count}
_SET = {
    "success": RATE,
    "first_stage_success": RATE,
    "median_rotation_error_deg": is_number,
    "median_translation_error": is_number,
}
_BEFORE: dict[str, Any] = {
    "overrides": [is_text],
    "run": {"update": is_count, "skipped": is_count, "updates_per_second": is_number, "peak_memory_mib": is_number},
    "config": {
        "batch_size": is_count,
        "model": {"n": is_count},
        "data": {"train": {"_target_": is_text}, "validation": {"*": {"_target_": is_text}}},
    },
    "environment": {"threads": is_count, "cpu": is_text, "commit": is_text_or_none, "versions": {"torch": is_text}},
}
_RUN: dict[str, Any] = {
    **_BEFORE,
    "us_per_problem": is_number,
    "validation": {"*": _SET},
    "learned": {name: [is_number] for name in _LEARNED},
    "model": {
        "init": is_mapping_or_none,
        "refine": {"m": is_count, "kernel": is_text},
        "views": is_count,
        "normalize": {"center": is_flag, "scale": is_flag},
    },
}
# Overrides that say how a run was done, not what it found.
_HOW_IT_RAN = ("resume", "progress", "threads", "data_workers", "compile")


def write_json(path: str | Path, content: Any) -> None:
    """Write a JSON file that people can read, in one piece.

    Args:
        path: of the file; folders are made when missing.
        content: plain data.

    Raises:
        TypeError: for what JSON does not know.
        ValueError: for numbers that are not finite.
        OSError: when the file cannot be written. In each case the old file stays as it was.
    """
    with atomic_open(path) as file:
        file.write(json.dumps(content, indent=2, allow_nan=False) + "\n")


@torch.no_grad()
def run_results(
    model: PnPNet,
    validation: Mapping[str, Problems],
    report: FitReport,
    config: dict[str, Any],
    overrides: list[str],
    origin: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Gather what a run found: success on each validation set, learned hyperparameters, speed, and how to repeat it.

    Args:
        model: the trained solver.
        validation: problems by name.
        report: what :func:`~kornia_pnpnet.training.fit` returned.
        config: the resolved configuration.
        overrides: the command line's overrides, ``key=value``.
        origin: the results of the run with whose weights this one began.

    Returns:
        Plain data, ready for :func:`write_json`.

    Raises:
        ValueError: when there is no validation set.
    """
    if not validation:
        raise ValueError("The results of a run need at least one validation set, got none.")
    sets = {}
    for name, problems in validation.items():
        result = model(*problems[:3], **problems.sigmas)
        errors = pose_errors(result.pose, problems.pose)
        first = pose_errors(result.init, problems.pose)
        sets[name] = {
            "success": success_rate(success(errors))._asdict(),
            "first_stage_success": success_rate(success(first))._asdict(),
            "median_rotation_error_deg": errors.rotation_error_deg.median().item(),
            "median_translation_error": errors.translation_error.median().item(),
            "first_stage_median_rotation_error_deg": first.rotation_error_deg.median().item(),
            "first_stage_median_translation_error": first.translation_error.median().item(),
        }
    learned = zip(_LEARNED, model.refine.hyperparameters(torch.zeros((), dtype=torch.float64)), strict=True)
    return {
        "overrides": overrides,
        "run": asdict(report),
        "us_per_problem": _us_per_problem(model, problems),
        "validation": sets,
        "learned": {name: values.tolist() for name, values in learned},
        "model": model.config(),
        "config": config,
        "environment": environment(),
        "origin": origin,
    }


def find_results(weights: str | Path) -> dict[str, Any] | None:
    """The results of the run that some weights are from.

    Args:
        weights: what :meth:`~kornia_pnpnet.solver.PnPNet.from_pretrained` takes.

    Returns:
        What :func:`run_results` returned then, or ``None`` where there is no such file beside the weights, or above
        a folder ``weights``.

    Raises:
        FileNotFoundError: when there are no such weights.
        ValueError: as of :func:`load_run`.
    """
    folder = find_weights(weights)
    # As `train.py` leaves them; above weights elsewhere it would be a file of something else.
    folders = [folder, folder.parent] if folder.name == "weights" else [folder]
    paths = (place / RESULTS_NAME for place in folders)
    return next((load_run(path) for path in paths if path.is_file()), None)


def load_run(path: str | Path) -> dict[str, Any]:
    """Read the results file of a run.

    Args:
        path: of the file that :func:`write_json` wrote of what :func:`run_results` returned.

    Returns:
        The results.

    Raises:
        FileNotFoundError: when there is no such file.
        ValueError: when it is not a results file of a run.
    """
    results = read_json(path, "a results file of a run")
    wrong = _wrong(results)
    if wrong is not None:
        raise ValueError(f"'{path}' is not a results file of a run: {wrong} is missing or not what it has to be.")
    return cast("dict[str, Any]", results)


def _wrong(results: Any) -> str | None:
    """The first of what is wrong with results of a run, or with those of the runs before it."""

    def all_wrong() -> Iterator[str]:
        yield from misfits(results, _RUN, "results")
        model, learned = results["model"], results["learned"]
        if not results["validation"]:
            yield "results.validation"
        if {len(learned[key]) for key in _LEARNED} != {max(1, model["refine"]["m"])}:
            yield "results.learned"
        if model["init"] is not None:
            form = _STARTS if model["init"].get("name") == "SetInit" else {"name": is_text}
            yield from misfits(model["init"], form, "results.model.init")
        before, name = results.get("origin"), "results.origin"
        while before is not None:
            yield from misfits(before, _BEFORE, name)
            before, name = before.get("origin"), f"{name}.origin"

    return next(all_wrong(), None)


def collect_weights(runs: Sequence[str | Path], folder: str | Path, *, most_rows: int = 100) -> None:
    """Gather what a solver came from into one folder: weights, results, model card and learning curves.

    Args:
        runs: folders of ``train.py``, each of which but the first began with the weights of the one before.
        folder: where the files go; its name is that of the weights.
        most_rows: of the curves of each run that are kept, all of them with a validation.

    Raises:
        BaseError: when ``most_rows`` is less than 1, or the weights are damaged or not all there.
        FileNotFoundError: when another file is missing.
        ValueError: when there is no run, or another file is damaged. In each case nothing is written.
    """
    check_whole(1, most_rows=most_rows)
    if not runs:
        raise ValueError("collect_weights needs at least one run, got none.")
    folder = Path(folder)
    rows: list[dict[str, str]] = []
    done = 0
    for path in (Path(run) / HISTORY_NAME for run in runs):
        there = read_rows(path)
        updates = map(int, read_column(path, there, "update", int))
        validated = [
            {**row, "update": str(done + update)}
            for row, update in zip(there, updates, strict=True)
            if any(value for key, value in row.items() if key.startswith("val/"))
        ]
        if not validated:
            raise ValueError(f"'{path}' has no row with a validation.")
        step = -(-len(validated) // most_rows)
        rows += reversed(validated[::-1][::step])  # the last one always
        done = int(rows[-1]["update"])
    last = Path(runs[-1])
    results = load_run(last / RESULTS_NAME)
    card = _card(results, folder.name)
    PnPNet.from_pretrained(last / "weights")
    folder.mkdir(parents=True, exist_ok=True)
    for name in (CONFIG_NAME, WEIGHTS_NAME):
        shutil.copyfile(last / "weights" / name, folder / name)
    write_json(folder / RESULTS_NAME, results)
    with atomic_open(folder / _CARD_NAME, "wb") as file:
        file.write(card)
    with atomic_open(folder / HISTORY_NAME, newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)), restval="")
        writer.writeheader()
        writer.writerows(rows)


def _us_per_problem(model: PnPNet, problems: Problems) -> float:
    """Microseconds per problem in calls of 1000: the shortest call, since other work on the machine only adds."""
    inputs = [part[:1000] for part in problems[:3]]
    seconds = []
    for _ in range(20):
        began = time.perf_counter()
        model(*inputs)
        seconds.append(time.perf_counter() - began)
    return 1e6 * min(seconds) / len(inputs[0])


def summarize_runs(folder: str | Path) -> Path | None:
    """Write ``summary.csv`` over the results files of a sweep.

    Args:
        folder: the sweep's folder, with one run per sub-folder.

    Returns:
        The summary's path, or ``None`` when there is no results file yet. A file that is not one of a run is left out,
        with a warning.

    Raises:
        OSError: when the summary cannot be written.
    """
    folder = Path(folder)
    rows = []
    for path in sorted(folder.glob(f"**/{RESULTS_NAME}")):
        try:
            results = load_run(path)
        except ValueError as error:
            warnings.warn(f"Left out of the summary: {error}", stacklevel=2)
            continue
        row: dict[str, Any] = {"run": str(path.parent.relative_to(folder))}
        overrides = (override.lstrip("+").partition("=") for override in results["overrides"])
        row |= {key: value for key, _, value in overrides}
        row |= {key: results["run"][key] for key in ("update", "skipped", "updates_per_second", "peak_memory_mib")}
        row["us_per_problem"] = f"{results['us_per_problem']:.4g}"
        for name, entry in results["validation"].items():
            row |= {f"{name}/{bound}": f"{entry['success'][bound]:.4f}" for bound in ("rate", "low", "high")}
        rows.append(row)
    if not rows:
        return None
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with atomic_open(folder / "summary.csv", newline="") as file:  # runs of a parallel launcher may end together
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)
    return folder / "summary.csv"


def _rate(entry: Mapping[str, float]) -> str:
    return f"{100 * entry['rate']:.1f} % [{100 * entry['low']:.1f}, {100 * entry['high']:.1f}]"


def _mix(source: Mapping[str, Any], n: int) -> str:
    """What a data source's configuration says of its wrong pairs and its points, or whose it is."""
    if _is_synthetic(source):
        with suppress(AttributeError, LookupError, TypeError, ValueError, BaseError):  # of options as they cannot be
            return _our_mix(source, n)
    named = dict.fromkeys(_targets(source))
    others = [name for name in named if not _is_ours(name)]
    return f"problems from {' and '.join(others or named)}"


def _is_ours(name: str) -> bool:
    """Whether a class is one of our synthetic sources, or of what they are made of."""
    return name.startswith("kornia_pnpnet.data.") and not name.endswith(".SceneProblems")


def _is_synthetic(source: Mapping[str, Any]) -> bool:
    """Whether a configuration names none but such classes."""
    return all(map(_is_ours, _targets(source)))


def _targets(config: Any) -> Iterator[str]:
    """All classes that a configuration names."""
    if isinstance(config, Mapping):
        if isinstance(config.get("_target_"), str):
            yield config["_target_"]
        config = list(config.values())
    if isinstance(config, list):
        for entry in config:
            yield from _targets(entry)


def _our_mix(source: Mapping[str, Any], n: int) -> str:
    """Wrong pairs and points of one of our synthetic sources."""
    sizes = source.get("n", n)
    sizes = sizes if isinstance(sizes, list) else [sizes]
    source = source.get("source", source)
    if any("outliers" in part for part in source.get("sources", ())):
        raise LookupError("Each source has wrong pairs of its own.")
    mix = source.get("outliers")
    draws = None if mix is None else OutlierMix(**{k: v for k, v in mix.items() if k != "_target_"})
    least, most = (0 if draws is None else draws.max_count(size) for size in (min(sizes), max(sizes)))
    least = least if len(sizes) > 1 or (mix is not None and mix.get("count") is not None) else 0
    of = f"of {max(sizes)} pairs wrong"
    wrong = f"{least} to {most} {of}" if most > least else f"{most} {of}"
    if len(sizes) > 1:
        wrong = f"{min(sizes)} to {max(sizes)} pairs, up to {least} of {min(sizes)} and {most} {of}"
    names = [name for part in source.get("sources", [source]) for name in _points({**source, **part})]
    return f"{wrong}, points from {' and '.join(names)}"


def _points(source: Mapping[str, Any]) -> list[str]:
    """The priors of the points of a source, and their noise where it is from a range."""
    prior = source.get("points") or {"_target_": "BoxPoints"}
    noise = source.get("world_sigma")
    known = f" (world_sigma {noise[0]:g} to {noise[1]:g})" if isinstance(noise, list) else ""
    return [entry["_target_"].rpartition(".")[2] + known for entry in prior.get("priors", [prior])]


# Absolute paths, not the slashes of a URL or of a relative path.
_PATH = re.compile(r"(?:file://|(?<![\w./\\])(?:~|[A-Za-z]:)?)(?:/(?!/)|\\)[^\s,;'\"\]})]*")


def _command(results: Mapping[str, Any]) -> str:
    """The command of a run: weights by the name of their run, and no folder of the machine that ran the command."""
    words = []
    for override in results["overrides"]:
        key, _, value = override.partition("=")
        if key == "weights" and results.get("origin") and _PATH.fullmatch(value):
            words.append(f"weights=outputs/{_run_name(results['origin'])}/weights")
        elif key not in _HOW_IT_RAN:
            words.append(_PATH.sub("PATH", override))
    return " ".join(["python train.py", *words])


def _run_name(results: Mapping[str, Any]) -> str:
    return str(results["config"].get("name") or "the run before")


def _start(results: Mapping[str, Any]) -> str:
    """The run whose weights a run began with, and options of the model that differ between both."""
    origin = results.get("origin")
    if not origin:
        return ""
    before, now = leaves(origin.get("model")), leaves(results.get("model"))
    changed = [f"{key} {before[key]}, now {now[key]}" for key in now if key in before and before[key] != now[key]]
    return f", from the weights of `{_run_name(origin)}`" + (f" with changes ({'; '.join(changed)})" if changed else "")


def _run_lines(results: Mapping[str, Any]) -> list[str]:
    """How a run was done; before it the one whose weights it began with."""
    run, config, made = results["run"], results["config"], results["environment"]
    most = "up to " if isinstance(config["data"]["train"].get("n"), list) else ""
    kind = "synthetic " if _is_synthetic(config["data"]["train"]) else ""
    return [
        *(_run_lines(results["origin"]) if results.get("origin") else []),
        f"- `{_command(results)}`{_start(results)}:",
        f"  {run['update']} updates of {most}{config['batch_size']} {kind}problems, {run['skipped']} of them skipped;",
        f"  {run['updates_per_second']:.1f} updates per second, peak memory {run['peak_memory_mib']:.0f} MiB,",
        f"  {made['threads']} thread(s) of {made['cpu']};",
        f"  {_mix(config['data']['train'], config['model']['n'])}.",
        f"  Commit {made['commit']}, torch {made['versions']['torch']}.",
    ]


def write_model_card(folder: str | Path, results: Mapping[str, Any], *, name: str | None = None) -> None:
    """Write ``README.md`` beside some weights, all of it from the run's results.

    Args:
        folder: where the weights are.
        results: what :func:`run_results` returned.
        name: of the weights, that of the run when ``None``.

    Raises:
        ValueError: when they are no such results.
        OSError: when the file cannot be written.
    """
    card = _card(results, name)
    with atomic_open(Path(folder) / _CARD_NAME, "wb") as file:
        file.write(card)


def _card(results: Mapping[str, Any], name: str | None) -> bytes:
    """The model card of some results; raises a ``ValueError`` when they are no such results."""
    wrong = _wrong(results)
    if wrong is not None:
        raise ValueError(f"No results of a run: {wrong} is missing or not what it has to be.")
    model, config, learned = results["model"], results["config"], results["learned"]
    n, m = config["model"]["n"], model["refine"]["m"]
    kind = (model["init"] or {}).get("name")
    start, scope = ("The paper's network", "Exactly") if kind else ("A start from the identity", "Trained on")
    views = model["views"]
    guesses = f" from {views} guesses for each problem" if views > 1 else ""
    what = f"{start} for n = {n} pairs"
    if kind == "SetInit":
        hypotheses = f"{model['init']['starts']} of its own and the best of {model['init']['samples']} P3P samples"
        what, guesses = "A network for any number of pairs", f"\nfrom several guesses, {hypotheses}"
    lines = [
        f"# {name or config.get('name') or kind or 'PnPNet'}",
        "",
        f"{what} and m = {m} iterations of robust weighted LM{guesses}",
        "(Sheffer and Wiesel, PnP-Net, 2020). Apache-2.0. Written from `results.json`, which has the configuration.",
        "",
        "    solver = kornia_pnpnet.PnPNet.from_pretrained(FOLDER)  # this one, or its name when it is shipped",
        "",
        "## Training",
        "",
        *_run_lines(results),
        *(f"- Validation, {key}: {_mix(source, n)}." for key, source in config["data"]["validation"].items()),
        "",
        "## Success on the validation sets",
        "",
        "Rotation error below 1° and translation error below 0.2, with 95 % intervals.",
        "",
        "| Set | PnP-Net | Net alone | median rotation error | median translation error |",
        "|---|---|---|---|---|",
    ]
    for validation, entry in results["validation"].items():
        lines.append(
            f"| {validation} | {_rate(entry['success'])} | {_rate(entry['first_stage_success'])} "
            f"| {entry['median_rotation_error_deg']:.3f}° | {entry['median_translation_error']:.3f} |"
        )
    if m > 0:
        lines += ["", "## Learned hyperparameters", ""]
        lines += [
            f"| Iteration | step γ | damping λ | robustness (`{model['refine']['kernel']}`) |",
            "|---|---|---|---|",
        ]
        for i, (step, damping, shape) in enumerate(zip(*(learned[key] for key in _LEARNED), strict=True), 1):
            lines.append(f"| {i} | {step:.3f} | {damping:.2e} | {shape:.3f} |")
    rotations = (
        "Rotations within about a quarter turn of the identity",
        ("(the world's axes roughly the camera's), which is the training's prior."),
    )
    if not _is_synthetic(config["data"]["train"]):
        rotations = "Rotations", "and points as in the training, too."
    centred = model["normalize"]["center"] and model["normalize"]["scale"]
    lines += ["", "## Limits", ""]
    if kind == "SetInit":
        lines += [
            "Any rotation, unit and origin of the world, and any camera: the network sees none of them. As many pairs",
            "and as many wrong ones as in the training; more pairs work too. Of three it gives one of the poses.",
            "",
        ]
    else:
        lines += [
            f"{scope} {n} pairs, with wrong ones as in the training. " + rotations[0],
            rotations[1]
            + " The world's unit and origin "
            + ("do not matter." if centred else "must be the training's."),
            "",
        ]
    return "\n".join(lines).encode()
