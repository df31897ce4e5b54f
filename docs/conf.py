"""How Sphinx builds the documentation: ``make docs``."""

import re
from pathlib import Path

from docutils.nodes import SkipNode
from latex2mathml.converter import convert

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
html_css_files = ["pages.css"]
html_js_files = ["pages.js"]

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
# Notebooks are run whenever the pages are built, and a failing one fails the build.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_render_markdown_format = "myst"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
# Aliases with rules for pydantic, by what a reader needs to know.
autodoc_type_aliases = {"Count": "int", "ModelConfig": "dict", "RunConfig": "dict", "RunEnvironment": "dict"}
python_use_unqualified_type_names = True
# A name of ours that leads nowhere is an error. Those of other projects and private ones have no page here.
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(torch|numpy|np|kornia|lightning_fabric|pathlib|types|collections|functools|pyarrow|pa)\..*"),
    ("py:class", r"Tensor|Count|Share|kornia_pnpnet\.(\w+\.)*(_\w+|Runner)"),
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
    """Replace links that leave the documentation by the path of their target in the repository."""

    def named(match):
        target = (Path(app.srcdir) / name).parent.joinpath(match[2]).resolve()
        if target.is_relative_to(app.srcdir):
            return match[0]
        return f"{match[1]} (`{target.relative_to(Path(app.srcdir).parent)}`)"

    source[0] = re.sub(r"\[([^]]*)\]\(([^):#]+)\)", named, source[0])


def _without_types(app, what, name, obj, options, lines):
    """Give Napoleon an empty type before the colon where it expects a type: signatures have the types."""
    starts = [i + 1 for i, line in enumerate(lines) if line.strip() in ("Returns:", "Yields:")]
    if lines and what in ("attribute", "data", "property"):
        starts.append(0)
    for i in starts:
        lines[i] = re.sub(r"(?=\S)", ": ", lines[i], count=1)


def _is_field(app, what, name, member, skip, options):
    """Leave out the fields of named tuples: the docstring of the class describes them."""
    return True if type(member).__name__ == "_tuplegetter" else None


def setup(app):
    """Register the handlers of formulas, links and docstrings."""
    app.connect("source-read", _outside)
    app.connect("autodoc-process-docstring", _without_types, priority=400)  # before napoleon
    app.connect("autodoc-skip-member", _is_field)
    app.add_html_math_renderer("mathml", inline_renderers=_math(False), block_renderers=_math(True))
