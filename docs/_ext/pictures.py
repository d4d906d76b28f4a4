"""Puts pictures into the gallery: where the last line of a block is a PIL image, the page shows it."""

from __future__ import annotations

from typing import Any

from PIL.Image import Image

_shown: set[int] = set()


def picture_scraper(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """A scraper as sphinx-gallery wants it; returns the text that shows the picture."""
    from sphinx_gallery.scrapers import figure_rst

    # The value of a block's last expression.
    picture = block_vars["example_globals"].get("___")
    if not isinstance(picture, Image) or id(picture) in _shown:
        return ""
    _shown.add(id(picture))
    block_vars["example_globals"].setdefault("_kept_pictures", []).append(picture)  # so that its id stays its own
    path = next(block_vars["image_path_iterator"])
    picture.convert("RGB").save(path)
    return figure_rst([path], gallery_conf["src_dir"])


def _get_sg_image_scraper() -> Any:
    """Where sphinx-gallery looks for the scraper of a module that is named in its configuration."""
    return picture_scraper
