"""The public interface is what `api.txt` says: a change of it is seen in a diff, and belongs into the changelog.

``python tests/test_api.py`` writes the file anew.
"""

import importlib
import inspect
import re
from pathlib import Path

FILE = Path(__file__).with_name("api.txt")
PAGES = Path(__file__).resolve().parents[1] / "docs" / "api"


def described(name, value):
    """A line for a name, and one for each public method or property of a class of ours."""
    if not callable(value):
        yield f"{name}: {type(value).__name__}"
        return
    yield name + signature(value)
    if not isinstance(value, type):
        return
    for member, found in sorted(vars(value).items()):
        if (member.startswith("_") and member != "__call__") or member == "extra_repr":
            continue
        if isinstance(found, property):
            yield f"{name}.{member}: property"
        elif callable(found) or isinstance(found, classmethod | staticmethod):
            yield f"{name}.{member}{signature(getattr(value, member))}"


def signature(value):
    """Names, kinds and defaults of parameters; annotations may change with their imports."""
    parameters = inspect.signature(value).parameters.values()
    plain = [x.replace(annotation=inspect.Parameter.empty) for x in parameters]
    # Defaults that are made anew have addresses in their text.
    text = str(inspect.Signature(plain)).replace("kornia_pnpnet.", "")
    return re.sub(r"<(function|object) ([\w.<>]+)( at 0x[0-9a-f]+)?>", r"<\2>", text)


def reference_modules():
    """Names of the modules that have a place in the reference."""
    text = "\n".join(page.read_text() for page in PAGES.glob("*.md"))
    return sorted(set(re.findall(r"automodule:: ([\w.]+)", text)))


def interface():
    """All that the reference lists."""
    lines = ["# kornia_pnpnet " + re.sub(r"\.\d+$", "", importlib.import_module("kornia_pnpnet").__version__)]
    modules = reference_modules()
    homes = {name: module for module in modules for name in importlib.import_module(module).__all__}
    for module in ("kornia_pnpnet", *modules):
        for name in sorted(importlib.import_module(module).__all__):
            if module == "kornia_pnpnet" and name in homes:
                lines.append(f"{module}.{name} = {homes[name]}.{name}")
            else:
                lines += described(f"{module}.{name}", getattr(importlib.import_module(module), name))
    return "\n".join(lines) + "\n"


def test_the_interface_is_as_it_was():
    assert interface() == FILE.read_text(), "It changed: tell the changelog, and run python tests/test_api.py"


if __name__ == "__main__":
    FILE.write_text(interface())
