"""Pages of cohorts and groups, which load nothing and run nothing."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from PIL import Image

from omtwarp.reporting.markup import figure, pictures, table, write_plain_page

sys.path.insert(0, str(Path(__file__).parent))
from browser import PROGRAM, Browser


def page_with_wide_content(folder: Path) -> Path:
    names = [f"column_{k}" for k in range(30)]
    shown = [figure(Image.new("RGB", (900, 300)), f"subject-{k}", "a picture") for k in range(3)]
    return write_plain_page(folder / "page.html", "a" * 200, [table(names, [names]), pictures(shown)])


def test_a_page_tells_a_phone_its_width_and_moves_only_the_table(tmp_path):
    text = page_with_wide_content(tmp_path).read_text("utf-8")
    assert '<meta name="viewport" content="width=device-width' in text
    assert "overflow-x: auto" in text


@pytest.mark.skipif(PROGRAM is None, reason="no Chromium on this machine")
def test_a_page_fits_a_phone(tmp_path):
    page = page_with_wide_content(tmp_path)
    shown = Browser(tmp_path / "profile")
    try:
        for width in (320, 390):
            shown.ask(
                "Emulation.setDeviceMetricsOverride", width=width, height=2 * width, deviceScaleFactor=1, mobile=True
            )
            shown.ask("Page.navigate", url=page.as_uri())
            shown.wait_for(f"location.href === {page.as_uri()!r} && document.readyState === 'complete'")
            assert shown.run("document.documentElement.scrollWidth") <= width
    finally:
        shown.close()
