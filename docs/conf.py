"""The documentation: ``python -m sphinx -W -b html docs docs/_build/html`` makes it, with every picture in it."""

from __future__ import annotations

import gc
import logging
import os
import re
import sys
from functools import cache
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
sys.path[:0] = [str(HERE / "_ext"), str(ROOT)]
os.environ.setdefault("WARP_CACHE_PATH", str(ROOT / ".warp"))
os.environ.setdefault("MPLBACKEND", "Agg")
# The processes that run notebook pages use this checkout, too.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
gc.set_threshold(200_000)  # Sphinx makes millions of objects that stay: to look for garbage took a third of the time
logging.getLogger("omtwarp.render").setLevel(logging.ERROR)  # which program drew a picture is no part of an example

from sphinx.util.nodes import make_refnode  # noqa: E402
from sphinx.util.osutil import relative_uri  # noqa: E402

import omtwarp  # noqa: E402

project = "omtwarp"
author = "the omtwarp developers"
copyright = "the omtwarp developers"
version = release = omtwarp.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_gallery.gen_gallery",
    "mathml",
    "commands",
    "report_page",
    "data_flow",
    "comparison_plot",
]
exclude_patterns = ["_build", "README.md", "gallery/*.ipynb"]
source_suffix = {".rst": "restructuredtext", ".md": "myst-nb"}
# Pages that begin with `file_format: mystnb` are notebooks: their cells run during the build, and have to succeed.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 900
nb_merge_streams = True
myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence"]
myst_heading_anchors = 3

nitpicky = True
nitpick_ignore_regex = [("py:(class|obj|exc|data|type)", r".*")]  # annotations name what other projects document
templates_path = ["_templates"]

html_theme = "furo"
html_title = f"omtwarp {release}"
html_static_path = ["_static"]
html_css_files = ["style.css"]
html_js_files = ["versions.js"]
html_sidebars = {
    "**": [
        "sidebar/brand.html",
        "versions.html",
        "sidebar/search.html",
        "sidebar/scroll-start.html",
        "sidebar/navigation.html",
        "sidebar/scroll-end.html",
    ]
}
html_math_renderer = "mathml"  # drawn by the browser itself: nothing to load, nothing to wait for
html_show_sphinx = False
html_copy_source = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#1f6f78", "color-brand-content": "#1f6f78"},
    "dark_css_variables": {"color-brand-primary": "#6cc3cc", "color-brand-content": "#6cc3cc"},
}
pygments_style = "friendly"
pygments_dark_style = "github-dark"

autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_type_aliases = {"ArrayLike": "ArrayLike", "NDArray": "NDArray"}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
python_maximum_signature_line_length = 88
maximum_signature_line_length = 88

sphinx_gallery_conf = {
    "examples_dirs": str(ROOT / "examples"),
    "gallery_dirs": "gallery",
    "filename_pattern": r"plot_",
    "ignore_pattern": r"^(?!plot_)",  # scripts with arguments are no pages
    "within_subsection_order": "FileNameSortKey",
    "image_scrapers": ("matplotlib", "pictures"),
    "capture_repr": (),
    "download_all_examples": False,
    "show_signature": False,
    "remove_config_comments": True,
    "min_reported_time": 1e9,
    "write_computation_times": False,
    "thumbnail_size": (480, 320),
    "copyfile_regex": "",
    "notebook_images": False,
    "only_warn_on_example_error": False,
    "abort_on_example_error": True,
    "plot_gallery": "True",
}

# Pages that other programs write; each is there once it was made.
OPTIONAL_PAGES = ("paper_tables", "comparison", "performance")


def name_optional_pages(app, document, source) -> None:
    """Put those that exist in the place of {{optional pages}} in a table of contents."""
    present = [name for name in OPTIONAL_PAGES if (HERE / f"{name}.md").exists()]
    source[0] = source[0].replace("{{optional pages}}", "\n".join(present))


def skip_what_is_public_above(app, what, name, member, skip, options) -> bool | None:
    """Describe an object that the package itself offers there, and not once more under its module."""
    return True if what == "module" and getattr(omtwarp, name, None) is member else None


def plain_text(app, what, name, member, options, lines) -> None:
    """Docstrings are read as they are in an editor: bars are absolute values, and a literal may have an exponent."""
    for k, line in enumerate(lines):
        pieces = re.split(r"(``[^`]+``)", line)  # every second piece is a literal
        pieces[::2] = [re.sub(r"(?<!\\)\|", r"\\|", piece) for piece in pieces[::2]]
        pieces[2::2] = [re.sub(r"^(?=[^\s.,:;!?)\]}'\"/>-])", r"\\ ", piece) for piece in pieces[2::2]]
        lines[k] = "".join(pieces)


@cache  # references are looked for once all pages are read
def names_by_last_name(env) -> dict[str, list[str]]:
    """Return the full names of all objects that are in something, by their last names."""
    found: dict[str, list[str]] = {}
    for name in env.get_domain("py").objects:
        if "." in name:
            found.setdefault(name.split(".")[-1], []).append(name)
    return found


def find_by_last_name(app, env, node, contnode):
    """Docstrings name things as their module does: find the one object of that name, at the top level first."""
    if node.get("refdomain") != "py":
        return None
    name = node["reftarget"].split(".")[-1]
    objects = env.get_domain("py").objects
    found = [f"omtwarp.{name}"] if f"omtwarp.{name}" in objects else names_by_last_name(env).get(name, [])
    if len(found) == 1:
        entry = objects[found[0]]
        return make_refnode(app.builder, node["refdoc"], entry.docname, entry.node_id, contnode, found[0])
    # What is internal has no page; in hand-written pages a name that leads nowhere is a mistake.
    return contnode if node["refdoc"].startswith("api/") else None


def lead_source_back(app, pagename, templatename, context, doctree) -> None:
    """Let the links of a source page lead to where an object is documented: below its module or below the package.

    ``sphinx.ext.viewcode`` keeps one of the two for all objects of a module, which is wrong for the others.
    """
    if not pagename.startswith("_modules/"):
        return
    module = pagename.removeprefix("_modules/").replace("/", ".")
    objects = app.env.get_domain("py").objects

    def link(match: re.Match) -> str:
        name = match[1].removeprefix(f"{module}.").removeprefix("omtwarp.")
        for full in (f"{module}.{name}", f"omtwarp.{name}"):
            if full in objects:
                entry = objects[full]
                page = relative_uri(app.builder.get_target_uri(pagename), app.builder.get_target_uri(entry.docname))
                return f'<a class="viewcode-back" href="{page}#{entry.node_id}">[docs]</a>'
        return ""

    back = r'<a class="viewcode-back" href="[^"#]*#([^"]+)">\[docs\]</a>'
    context["body"] = re.sub(back, link, context["body"])


def setup(app) -> None:
    app.connect("html-page-context", lead_source_back)
    app.connect("missing-reference", find_by_last_name)
    app.connect("source-read", name_optional_pages)
    app.connect("autodoc-skip-member", skip_what_is_public_above)
    app.connect("autodoc-process-docstring", plain_text)
