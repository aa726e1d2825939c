"""The content of a wheel besides the code: the box's flashable image, and a README with links for a package index."""

import os
import re
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

URL = "TRUEARM_URL"  # of the repository; make release URL=https://… sets it


class ImageHook(BuildHookInterface):  # type: ignore[misc]
    """Put the image of this version (make uf2) into the package; a checkout without one builds without it."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the image to the build; an editable installation finds it in the checkout."""
        image = Path(self.root) / "build" / "uf2" / f"truearm-{self.metadata.version}.uf2"
        if version == "editable" or not image.is_file():
            return
        inside = "truearm/box/image" if self.target_name == "wheel" else "build/uf2"
        build_data["force_include"][str(image)] = f"{inside}/{image.name}"


class LinksHook(MetadataHookInterface):  # type: ignore[misc]
    """Make the README's links absolute if the repository's address is given; otherwise they are unchanged."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set readme and urls."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        url = os.environ.get(URL, "").rstrip("/")
        metadata["urls"] = {"Source": url, "Changelog": f"{url}/blob/HEAD/CHANGELOG.md"} if url else {}
        if url:
            text = re.sub(r"!\[([^]]*)\]\((?!\w+:|#)", rf"![\1]({url}/raw/HEAD/", text)
            text = re.sub(r"(?<!\!)\[([^]]*)\]\((?!\w+:|#)", rf"[\1]({url}/blob/HEAD/", text)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
