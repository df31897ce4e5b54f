"""Save weights as safetensors, and load weights from the package, a local folder, or the Hugging Face Hub."""

from __future__ import annotations

import copy
import inspect
import json
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any, Self

import torch
from kornia.core.exceptions import BaseError, ValueCheckError
from torch import Tensor, nn

from kornia_pnpnet.core.files import atomic_open, digest, write_json
from kornia_pnpnet.core.performance import Runner
from kornia_pnpnet.frame import Normalize
from kornia_pnpnet.propose.epnp import EPnP
from kornia_pnpnet.propose.minimal import describe
from kornia_pnpnet.propose.mlp import MLPInit
from kornia_pnpnet.propose.reppnp import REPPnP
from kornia_pnpnet.propose.set import SetInit
from kornia_pnpnet.refine.lm import RobustWeightedLM

__all__ = ["PretrainedMixin", "find_weights", "read_weights", "shipped_weights", "write_weights"]

WEIGHTS_FOLDER = Path(__file__).parent / "weights"
CONFIG_NAME, WEIGHTS_NAME = "config.json", "model.safetensors"
# Key of the digest in the metadata of the weights file.
_FINGERPRINT = "sha256"
# Largest number of bytes that are read from a configuration file. Every valid file is smaller.
_LARGEST_CONFIG = 2**20
# Integers up to this value are accepted in every configuration, because tensors of these sizes take little memory. Only
# `layers` has a lower limit.
_SMALL = 1000
# Options that are lengths or scales, but not sizes of tensors.
_LENGTHS = ("algebraic_weight", "f_const", "img_scale", "max_error", "robustness", "world_scale")


def shipped_weights() -> list[str]:
    """Names of the weights that come with the package."""
    return sorted(path.parent.name for path in WEIGHTS_FOLDER.glob(f"*/{CONFIG_NAME}"))


def write_weights(folder: str | Path, config: Mapping[str, Any], state: Mapping[str, Tensor]) -> None:
    """Write constructor arguments to ``config.json`` and named tensors to ``model.safetensors`` in a folder."""
    from safetensors.torch import save

    state = {name: value.detach().cpu().contiguous() for name, value in state.items()}
    with atomic_open(Path(folder) / WEIGHTS_NAME, "wb") as file:
        file.write(save(state, {"format": "pt", _FINGERPRINT: _fingerprint(config, state)}))
    write_json(Path(folder) / CONFIG_NAME, config)


def read_weights(name_or_folder: str | Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read the arguments and tensors that :func:`write_weights` wrote. No code in the files is run.

    Raises:
        FileNotFoundError: see :func:`find_weights`.
        ValueCheckError: when the files are damaged or do not belong together.
    """
    folder = find_weights(name_or_folder)
    from safetensors import SafetensorError, safe_open

    try:
        for name in (CONFIG_NAME, WEIGHTS_NAME):
            if not (folder / name).is_file():  # opening a pipe would block forever
                raise ValueError(f"{name} is not a regular file")
        with (folder / CONFIG_NAME).open("rb") as text:
            config = json.loads(text.read(_LARGEST_CONFIG))
        with safe_open(folder / WEIGHTS_NAME, "pt") as file:
            metadata = file.metadata() or {}
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, ValueError, RecursionError, SafetensorError) as error:
        raise ValueCheckError(f"Cannot read the weights in {folder}: {error}") from error
    if _FINGERPRINT in metadata and metadata[_FINGERPRINT] != _fingerprint(config, state):
        raise ValueCheckError(f"The weights in {folder} are damaged: {CONFIG_NAME} and {WEIGHTS_NAME} do not match.")
    _check(folder, config, state)  # before a module of such a size is built
    return config, state


def _check(folder: Path, config: Any, state: Mapping[str, Tensor]) -> None:
    """Refuse tensors that are not finite, and integers above the largest dimension of the tensors."""
    for name, tensor in state.items():
        if not tensor.isfinite().all():
            raise ValueCheckError(f"The weights in {folder} are not finite: {name}.")
    largest = max([_SMALL, *(size for tensor in state.values() for size in tensor.shape)])
    entries = [("", config)]
    while entries:
        name, entry = entries.pop()
        if isinstance(entry, Mapping):
            entries += entry.items()
        elif isinstance(entry, int) and name not in _LENGTHS and entry > (len(state) if name == "layers" else largest):
            raise ValueCheckError(f"{folder / CONFIG_NAME}: {name} is {entry}, too large for {WEIGHTS_NAME}.")


def _fingerprint(config: Any, state: Mapping[str, Tensor]) -> str:
    return digest(config, *chain.from_iterable(sorted(state.items())))


def find_weights(name_or_folder: str | Path) -> Path:
    """Find shipped weights of the given name, else a local folder, else a repository of the Hugging Face Hub.

    A :class:`~pathlib.Path` is always a local folder.

    Raises:
        FileNotFoundError: when no shipped weights, folder or repository has this name.
    """
    name = str(name_or_folder)
    for folder in (Path(name),) if isinstance(name_or_folder, Path) else (WEIGHTS_FOLDER / name, Path(name)):
        if (folder / CONFIG_NAME).is_file():
            return folder
    files = f"a folder needs {CONFIG_NAME} and {WEIGHTS_NAME}"
    message = f"No weights {name!r}: shipped weights are {shipped_weights()}; {files}"
    if isinstance(name_or_folder, Path) or name.count("/") != 1 or Path(name).exists():
        raise FileNotFoundError(f"{message}.")
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import HfHubHTTPError

    try:
        hf_hub_download(name, WEIGHTS_NAME)
        return Path(hf_hub_download(name, CONFIG_NAME)).parent
    except (HfHubHTTPError, OSError, ValueError) as error:
        raise FileNotFoundError(f"{message}; the Hub said: {error}") from error


_INITIALISERS: dict[str, type[nn.Module]] = {x.__name__: x for x in (EPnP, MLPInit, REPPnP, SetInit)}


class PretrainedMixin(nn.Module):
    """This base class of :class:`~kornia_pnpnet.PnPNet` saves, loads and copies solvers."""

    init: nn.Module | None
    refine: RobustWeightedLM
    normalize: Normalize
    _run: Runner
    _whole: Runner

    @classmethod
    def option_names(cls) -> list[str]:
        """Names of the options: keyword-only arguments of the constructor, and those it passes on in ``**kwargs``."""
        names: dict[str, None] = {}
        for base in (x for x in cls.__mro__ if "__init__" in vars(x)):
            parameters = inspect.signature(vars(base)["__init__"]).parameters.values()
            names |= {x.name: None for x in parameters if x.kind is inspect.Parameter.KEYWORD_ONLY}
            if all(x.kind is not inspect.Parameter.VAR_KEYWORD for x in parameters):
                break
        return list(names)

    @property
    def options(self) -> dict[str, Any]:
        """The options of this solver, as the arguments of its constructor."""
        return {name: getattr(self, name) for name in self.option_names()}

    def extra_repr(self) -> str:
        """Show the options."""
        return ", ".join(f"{name}={value!r}" for name, value in self.options.items())

    def with_options(self, *, refine: RobustWeightedLM | None = None, **options: Any) -> Self:
        """Copy the solver with another refinement or other options. The copy and the solver share unchanged modules."""
        copied = type(self)(self.init, refine or self.refine, self.normalize, **{**self.options, **options})
        copied._run, copied._whole = copy.copy(self._run), copy.copy(self._whole)
        copied.training = self.training  # `train` would also change the modules that both solvers share
        if refine is not None:
            refine.train(self.training)
        return copied

    def config(self) -> dict[str, Any]:
        """The constructor arguments of all parts, and the options, as plain data."""
        init = None if self.init is None else describe(self.init)
        return {"init": init, "refine": self.refine.config, "normalize": self.normalize.config, **self.options}

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> Self:
        """Build an untrained solver from the result of :meth:`config`. Missing options get their default values.

        Raises:
            ValueCheckError: when a part or an argument is unknown.
        """
        try:
            options = dict(config)
            init, refine, normalize = (options.pop(part) for part in ("init", "refine", "normalize"))
            if init is not None:
                init = _INITIALISERS[init["name"]](**{key: x for key, x in init.items() if key != "name"})
            return cls(init, RobustWeightedLM(**refine), Normalize(**normalize), **options)
        except (BaseError, KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueCheckError(f"Not a configuration of PnPNet: {error!r}.") from error

    def save_pretrained(self, folder: str | Path) -> None:
        """Write ``config.json`` and ``model.safetensors`` to a folder. A missing folder is created.

        Raises:
            ValueCheckError: for RANSAC or an initialiser of your own, and when :meth:`from_pretrained` would refuse
                the files.
        """
        config = self.config()
        if self.init is not None and config["init"]["name"] not in _INITIALISERS:
            raise ValueCheckError(f"{config['init']['name']} cannot be saved, only {sorted(_INITIALISERS)} can.")
        state = self.state_dict()
        _check(Path(folder), config, state)
        write_weights(folder, config, state)

    @classmethod
    def from_pretrained(cls, name_or_folder: str | Path) -> Self:
        """Load a trained solver in evaluation mode. Its parameters require gradients.

        To train the solver further, call ``solver.train()`` first. For inference alone, use ``torch.no_grad()`` or
        ``solver.requires_grad_(False)``, or load a shipped solver with :func:`~kornia_pnpnet.create_solver`.

        Args:
            name_or_folder: see :func:`~kornia_pnpnet.pretrained.find_weights`. No code in the files is run.

        Returns:
            The solver in float32 on PyTorch's default device.

        Raises:
            FileNotFoundError: when no shipped weights, folder or repository has this name.
            ValueCheckError: when the files are damaged or belong to another model.
        """
        config, state = read_weights(name_or_folder)
        with torch.random.fork_rng(devices=[]), torch.device("cpu"):  # random initial weights would draw numbers
            model = cls.from_config(config).float()
        try:
            model.load_state_dict(state)
        except RuntimeError as error:
            raise ValueCheckError(f"The weights {name_or_folder} belong to another model: {error}") from error
        return model.to(torch.get_default_device()).eval()
