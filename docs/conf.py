"""How Sphinx builds the documentation: ``make docs``."""

import re
from pathlib import Path

from docutils.nodes import SkipNode
from latex2mathml.converter import convert
from sphinx.pycode import ModuleAnalyzer

import kornia_pnpnet

project = "kornia_pnpnet"
author = copyright = "The kornia_pnpnet authors"
version = release = kornia_pnpnet.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build", "results/make.py"]
html_theme = "furo"
html_title = f"kornia_pnpnet {version}"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_favicon = "_static/favicon.svg"
html_css_files = ["pages.css"]
html_js_files = ["pages.js"]

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
# Notebooks are run whenever the pages are built, and a failing one fails the build.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_render_markdown_format = "myst"

toc_object_entries_show_parents = "hide"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
# Aliases with rules for pydantic, by what a reader needs to know.
autodoc_type_aliases = {"Count": "int", "ModelConfig": "dict", "RunConfig": "dict", "RunEnvironment": "dict"}
python_use_unqualified_type_names = True
# A name of ours that leads nowhere is an error. Other projects, private names and ``core`` have no page here.
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(torch|numpy|np|kornia|lightning_fabric|pathlib|types|collections|functools|pyarrow|pa)\..*"),
    ("py:class", r"Tensor|Count|Share|kornia_pnpnet\.(\w+\.)*(_\w+|Runner)"),
    ("py:.*", r"(kornia_pnpnet\.)?core\..*|Symmetric[23]|solve_positive"),
    ("py:exc", r"(Base|Device|Shape|TypeCheck|ValueCheck)Error"),
]
napoleon_numpy_docstring = False  # all are Google's
napoleon_use_ivar = True  # else fields of named tuples would be there twice


def _math(display):
    """Formulas as MathML, which browsers draw by themselves."""

    def visit(translator, node):
        text = convert(node.astext(), display="block" if display else "inline")
        translator.body.append(f'<div class="math">{text}</div>' if display else text)
        raise SkipNode

    return visit, None


def _outside(app, name, source):
    """Lead links out of the documentation to the page of a benchmark, or to a copy of the file."""

    def led(match):
        text, path, place = match.groups()
        target = (Path(app.srcdir) / name).parent.joinpath(path).resolve()
        if target.is_relative_to(app.srcdir):
            return match[0]
        here = target.relative_to(Path(app.srcdir).parent)
        if (Path(app.srcdir) / here).exists():
            return f"[{text}](/{here.as_posix()}{place or ''})"
        return f"{{download}}`{text.strip('`')} <{path}>`" if target.is_file() else f"{text} (`{here}`)"

    source[0] = re.sub(r"(?<!!)\[([^]]*)\]\(([^):#\s]+)(#[^)]*)?\)", led, source[0])


def _without_types(app, what, name, obj, options, lines):
    """Give Napoleon an empty type before the colon where it expects a type: signatures have the types."""
    starts = [i + 1 for i, line in enumerate(lines) if line.strip() in ("Returns:", "Yields:")]
    if lines and what in ("attribute", "data", "property"):
        starts.append(0)
    for i in starts:
        lines[i] = re.sub(r"(?=\S)", ": ", lines[i], count=1)


def _is_field(app, what, name, member, skip, options):
    """Leave out the fields of named tuples, which are described with the class."""
    return True if type(member).__name__ == "_tuplegetter" else None


def _with_fields(app, what, name, obj, options, lines):
    """Describe the fields of a named tuple by their comments."""
    if what == "class" and hasattr(obj, "_fields"):
        comments = ModuleAnalyzer.for_module(obj.__module__).find_attr_docs()
        described = {field: comments.get((obj.__qualname__, field)) for field in obj._fields}
        fields = [f"    {field}: {' '.join(text).strip()}" for field, text in described.items() if text]
        lines += ["Attributes:", *fields, ""] if fields else []


def setup(app):
    """Register the handlers of formulas, links and docstrings."""
    app.connect("source-read", _outside)
    app.connect("autodoc-process-docstring", _with_fields, priority=300)
    app.connect("autodoc-process-docstring", _without_types, priority=400)  # before napoleon
    app.connect("autodoc-skip-member", _is_field)
    app.add_html_math_renderer("mathml", inline_renderers=_math(False), block_renderers=_math(True))
