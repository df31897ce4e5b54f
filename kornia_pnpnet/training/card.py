"""The model card of trained weights: a short template that is filled with the results of the training run."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from kornia_pnpnet.core.files import atomic_open
from kornia_pnpnet.training.results import RunResults

__all__ = ["HOW_IT_RAN", "write_model_card"]

_TAGS = ["camera-pose-estimation", "kornia", "perspective-n-point", "pnp"]
#: Overrides of ``train.py`` that do not change the results of a run.
HOW_IT_RAN = ("resume", "progress", "threads", "data_workers", "compile")
# Matches absolute paths, but not the slashes of a URL or of a relative path.
_PATH = re.compile(r"(?:file://|(?<![\w./\\])(?:~|[A-Za-z]:)?)(?:/(?!/)|\\)[^\s,;'\"\]})]*")
_OLD_PLACE = re.compile(r"outputs/[^/]*")  # where runs of early commits wrote weights
_CARD = """---
{metadata}
---

# {name}

A PnP-Net (Sheffer and Wiesel, PnP-Net, 2020): camera pose from 2D-3D correspondences with outliers.

```python
from kornia_pnpnet import PnPNet

solver = PnPNet.from_pretrained("{name}")  # a shipped name, or the folder of this file
```

## Training

{runs}

`results.json` holds the whole configuration, the data, the learned hyperparameters and the speed of every run.

## Success on the validation sets

A success has a rotation error below 1° and a translation error below 0.2. Intervals are 95 % Wilson intervals.

| Set | PnP-Net | Initial pose | Median rotation error | Median translation error |
|---|---|---|---|---|
{rows}
"""


def write_model_card(folder: str | Path, results: RunResults, *, name: str | None = None) -> None:
    """Write ``README.md`` into the folder of weights, with metadata for the Hugging Face Hub.

    ``results`` are the results of the run that trained the weights. The default ``name`` is the name of this run.
    """
    from huggingface_hub import EvalResult, ModelCardData

    name = name or results.name
    rates, rows = [], []
    for key, x in results.validation.items():
        rate = round(x.success.rate, 4)
        rates.append(EvalResult("pose-estimation", "validation", key, "success-rate", rate, dataset_config=key))
        errors = f"{x.median_rotation_error_deg:.3f}° | {x.median_translation_error:.3f}"
        rows.append(f"| {key} | {x.success} | {x.first_stage_success} | {errors} |")
    metadata = ModelCardData(
        license="apache-2.0", library_name="kornia_pnpnet", tags=_TAGS, model_name=name, eval_results=rates
    )
    runs = [f"{number}. {_describe(run)}" for number, run in enumerate(results.lineage(), 1)]
    with atomic_open(Path(folder) / "README.md", encoding="utf-8") as file:
        file.write(_CARD.format(metadata=metadata.to_yaml(), name=name, runs="\n".join(runs), rows="\n".join(rows)))


def _describe(results: RunResults) -> str:
    """Describe a run in one line with its command. Absolute paths become ``PATH``, except ``weights`` of known runs."""
    words = ["python", "train.py"]
    for override in results.overrides:
        key, _, value = override.partition("=")
        if key == "weights" and results.origin is not None and (_PATH.fullmatch(value) or _OLD_PLACE.fullmatch(value)):
            words.append(f"weights=outputs/{results.origin.name}/weights")  # where `train.py` writes weights
        elif key not in HOW_IT_RAN:
            words.append(_PATH.sub("PATH", override))
    start = f", from the weights of {results.origin.name}" if results.origin else ""
    made = f"{results.run.update} updates{start}, commit {results.environment['commit']}"
    return f"{results.name}: `{shlex.join(words)}` ({made})"
