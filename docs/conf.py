"""Configuration of Sphinx. `make docs` builds the pages and runs their code, without data and network.

Formulas are set by a MathJax that is copied into the site, so that the pages need no network either.
"""

import os
import re
import sys
import tomllib
from pathlib import Path

import nbformat

import kornia_learnnorm
from kornia_learnnorm.cli.main import make_parser

project = "kornia_learnnorm"
author = "the authors of kornia_learnnorm"
copyright = author
release = version = kornia_learnnorm.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax", "sphinx.ext.viewcode"]
sys.path.insert(0, str(Path(__file__).parent))
extensions += ["results_directive", "sphinx.ext.autosummary", "sphinx_copybutton"]
extensions += ["sphinxarg.ext", "sphinx-mathjax-offline"]
exclude_patterns = ["_build"]
smartquotes = False  # they turn the two dashes of options into one
html_theme = "furo"
html_title = f"kornia-learnnorm {release}"
html_static_path = ["_static"]
html_css_files = ["narrow.css"]

# Names of modules in the reference must resolve; other packages and modules that are not in it have no pages here.
nitpicky = True
LISTED = [re.findall(r"automodule:: (\S+)", page.read_text()) for page in (Path(__file__).parent / "api").glob("*.md")]
HERE = "|".join(re.escape(module) for modules in LISTED for module in modules)
nitpick_ignore_regex = [(r"py:.*", rf"(?!kornia_learnnorm\.\w+$|({HERE})(\.|$)).*")]

copybutton_selector = "div.highlight pre:not(div.cell_output pre)"  # code, not what it prints

autosummary_generate = False  # its tables link to the descriptions of the modules
viewcode_follow_imported_members = False  # NumPy has types without sources
add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_custom_sections = [("Attributes", "params_style")]

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 3

# A cache would keep outputs of code that has changed since: every build runs every page.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 900  # seconds a cell; a busy machine takes many times as long as an idle one
nb_merge_streams = True
nb_render_markdown_format = "myst"

# Colab opens notebooks of repositories on GitHub: the workflow pages.yml pushes those of the tutorials to a branch.
PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
REPOSITORY = PROJECT["urls"].get("Repository", "").rstrip("/")
COLAB = REPOSITORY.replace("https://github.com", "https://colab.research.google.com/github") + "/blob/notebooks"
INSTALL = f"%pip install --quiet 'kornia-learnnorm[train,images,report] @ git+{REPOSITORY}'\n%env DOWNLOAD=1"

ROLE = re.compile(r"\{[\w:-]+\}`[~./]*([^`<]+?)(\s*<[^`]*>)?`")  # text, and a target where the text is not it


def command_parser():
    """Return the parser for the page of the command line, its examples as literal blocks."""
    parser = make_parser()
    (commands,) = (action.choices for action in parser._actions if action.dest == "command")  # noqa: SLF001
    for command in (parser, *commands.values()):
        command.epilog = command.epilog.replace("examples:\n", "Examples::\n\n")
    return parser


def _skip_tuple_fields(app, what, name, obj, skip, options):
    """Leave out the fields of named tuples: their classes describe them."""
    return True if type(obj).__name__ == "_tuplegetter" else None


def _no_arguments(app, what, name, obj, options, signature, returns):
    """Show modules without a constructor of their own as taking no arguments."""
    return ("()", returns) if signature == "(*args, **kwargs)" else None


def _resolve_exported(app, env, node, contnode):
    """Find names of the package itself in the modules that define them, attributes and constants by their owner."""
    target, role = node.get("reftarget", ""), node.get("reftype")
    name, _, member = target.removeprefix("kornia_learnnorm.").partition(".")
    if name in kornia_learnnorm.__all__:
        target = ".".join([getattr(kornia_learnnorm, name).__module__, name, *filter(None, [member])])
    elif role != "data":
        return None
    owner = {"attr": "class", "data": "mod"}.get(role)
    if owner is not None:
        target, role = target.rpartition(".")[0], owner
    return env.get_domain("py").resolve_xref(env, node["refdoc"], app.builder, role, target, node, contnode)


def _plain_notebook(app, doctree):
    """Rewrite the notebook that a tutorial offers for download: Jupyter does not know Sphinx's roles."""
    if not app.env.docname.startswith("tutorials/"):
        return
    path = Path(app.env.mystnb_config.output_folder, f"{app.env.docname}.ipynb")
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            lines = [line for line in cell.source.splitlines() if "{nb-download}" not in line]
            cell.source = ROLE.sub(lambda role: role[1] if role[2] else f"`{role[1]}`", "\n".join(lines))
    if REPOSITORY:
        notebook.cells.insert(0, nbformat.v4.new_code_cell(INSTALL))
    nbformat.write(notebook, path)


def _link_colab(app, docname, source):
    """Add a link to Colab behind that to the notebook of a tutorial."""
    if REPOSITORY and docname.startswith("tutorials/"):
        link = f"[Open it in Colab]({COLAB}/{Path(docname).name}.ipynb)."
        source[0] = re.sub(r"^(\{nb-download\}.*)$", rf"\1 {link}", source[0], count=1, flags=re.MULTILINE)


def setup(app):
    """Connect what the settings above cannot say."""
    # It adds a file to the site and reads no page, but does not declare that it is safe for parallel reading.
    app.extensions["sphinx-mathjax-offline"].parallel_read_safe = True
    app.connect("source-read", _link_colab)
    app.connect("doctree-read", _plain_notebook)
    # The kernels of the pages inherit the style of figures, results_tables.py, and a path that has learnnorm.
    os.environ["MATPLOTLIBRC"] = str(app.confdir)
    if (weights := Path(app.confdir).parent / ".weights").is_dir():  # made by make weights
        os.environ.setdefault("TORCH_HOME", str(weights))
    os.environ["PYTHONPATH"] = os.pathsep.join([str(app.confdir), *filter(None, [os.environ.get("PYTHONPATH")])])
    os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    app.connect("autodoc-skip-member", _skip_tuple_fields)
    app.connect("autodoc-process-signature", _no_arguments)
    app.connect("missing-reference", _resolve_exported)
