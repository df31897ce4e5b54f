"""The model card of trained weights, written from the results of their run and a template."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from kornia_pnpnet.core.files import atomic_open
from kornia_pnpnet.data import OutlierMix
from kornia_pnpnet.training.checkpoint import leaves
from kornia_pnpnet.training.results import RunResults

__all__ = ["write_model_card"]

_CARD_NAME = "README.md"
_TEMPLATE = Path(__file__).with_name("model_card.md.jinja")
_TAGS = ["camera-pose-estimation", "kornia", "perspective-n-point", "pnp"]
# Overrides that change how a run is carried out and not what the run finds.
_HOW_IT_RAN = ("resume", "progress", "threads", "data_workers", "compile")
# Absolute paths, not the slashes of a URL or of a relative path.
_PATH = re.compile(r"(?:file://|(?<![\w./\\])(?:~|[A-Za-z]:)?)(?:/(?!/)|\\)[^\s,;'\"\]})]*")


def write_model_card(folder: str | Path, results: RunResults, *, name: str | None = None) -> None:
    """Write ``README.md`` beside weights, with metadata for the Hugging Face Hub.

    Args:
        folder: folder of the weights.
        results: results of the run that trained the weights.
        name: name of the weights; that of the run when ``None``.

    Raises:
        OSError: when the file cannot be written.
    """
    from huggingface_hub import EvalResult, ModelCard, ModelCardData

    name = name or results.name
    n = results.config["model"]["n"]
    rates = [
        EvalResult("pose-estimation", "validation", key, "success-rate", round(x.success.rate, 4), dataset_config=key)
        for key, x in results.validation.items()
    ]
    data = ModelCardData(
        license="apache-2.0", library_name="kornia_pnpnet", tags=_TAGS, model_name=name, eval_results=rates
    )
    card = ModelCard.from_template(
        data,
        template_path=str(_TEMPLATE),
        name=name,
        results=results,
        runs=[_describe_run(run) for run in results.lineage()],
        sets={key: _describe_data(source, n) for key, source in results.config["data"]["validation"].items()},
        synthetic=_is_synthetic(results.config["data"]["train"]),
    )
    with atomic_open(Path(folder) / _CARD_NAME, encoding="utf-8") as file:
        file.write(f"{card}\n")  # Jinja drops the last line break


def _describe_run(results: RunResults) -> dict[str, Any]:
    """Texts on a run for the template; the command without folders of the machine that ran the command."""
    config, origin = results.config, results.origin
    words = []
    for override in results.overrides:
        key, _, value = override.partition("=")
        if key == "weights" and origin is not None and _PATH.fullmatch(value):
            words.append(f"weights=outputs/{origin.name}/weights")  # where `train.py` writes them
        elif key not in _HOW_IT_RAN:
            words.append(_PATH.sub("PATH", override))
    before, now = leaves(origin.model if origin else {}), leaves(results.model)
    changed = [key for key in now if key in before and before[key] != now[key]]
    return {
        "name": results.name,
        "command": " ".join(["python train.py", *words]),
        "origin": origin and origin.name,
        "changes": [f"`{key}` was {before[key]} and is {now[key]}" for key in changed],
        "report": results.run,
        "batch": f"{'up to ' if isinstance(config['data']['train'].get('n'), list) else ''}{config['batch_size']}",
        "kind": "synthetic problems" if _is_synthetic(config["data"]["train"]) else "problems",
        "data": _describe_data(config["data"]["train"], config["model"]["n"]),
        "environment": results.environment,
    }


def _targets(config: Any) -> Iterator[str]:
    """Names of all classes in a configuration."""
    if isinstance(config, Mapping):
        if isinstance(config.get("_target_"), str):
            yield config["_target_"]
        config = list(config.values())
    if isinstance(config, list):
        for entry in config:
            yield from _targets(entry)


def _is_ours(name: str) -> bool:
    """Whether a class is one of the package's synthetic sources or one of their parts."""
    return name.startswith("kornia_pnpnet.data.") and not name.endswith(".SceneProblems")


def _is_synthetic(source: Mapping[str, Any]) -> bool:
    return all(map(_is_ours, _targets(source)))


def _describe_data(source: Mapping[str, Any], n: int) -> str:
    """Outliers and points of the package's synthetic sources; of other sources, the names of their classes."""
    if _is_synthetic(source):
        try:
            return _describe_synthetic(source, n)
        except Exception:  # a file may hold any options: name the classes then
            pass
    names = dict.fromkeys(_targets(source))
    others = [name for name in names if not _is_ours(name)]
    return f"problems from {' and '.join(others or names)}"


def _describe_synthetic(source: Mapping[str, Any], n: int) -> str:
    sizes = source.get("n", n)
    sizes = sizes if isinstance(sizes, list) else [sizes]
    source = source.get("source", source)
    parts = source.get("sources", [{}])
    if any("outliers" in part for part in parts):
        raise LookupError("Each part has outliers of its own.")
    options = {key: value for key, value in (source.get("outliers") or {"max_ratio": 0.0}).items() if key != "_target_"}
    mix, small, large = OutlierMix(**options), min(sizes), max(sizes)
    most = mix.max_count(large)
    if small < large:
        pairs = (
            f"{small} to {large} pairs, up to {mix.max_count(small)} outliers among {small} and {most} among {large}"
        )
    else:
        least = mix.least_count(large)
        pairs = f"{f'{least} to ' if least < most else ''}{most} outliers among {large} pairs"
    return f"{pairs}, points from {' and '.join(name for part in parts for name in _points({**source, **part}))}"


def _points(source: Mapping[str, Any]) -> list[str]:
    """Classes of a source's points, with the noise of the points where it is drawn from a range."""
    prior = source.get("points") or {"_target_": "BoxPoints"}
    sigma = source.get("world_sigma")
    noise = f" (world_sigma {sigma[0]:g} to {sigma[1]:g})" if isinstance(sigma, list) else ""
    return [entry["_target_"].rpartition(".")[2] + noise for entry in prior.get("priors", [prior])]
