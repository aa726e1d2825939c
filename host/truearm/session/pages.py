"""Documents longer than a frame, joined from their pages (protocol/SPEC.md §5)."""

from __future__ import annotations

from truearm_wire.messages import PAGE_BYTES, PAGES_MAX


class Pages:
    """Joins the pages of one document at a time; what it holds is bounded by the specification.

    Page 0 begins a document and drops an unfinished one. A page that repeats an earlier one is ignored, and so is a page
    of another document; one that contradicts an earlier one, or comes before its turn, drops the document.
    """

    def __init__(self) -> None:
        self._key: tuple[int, int] | None = None  # req_id and number of pages of the document being joined
        self._parts: list[bytes] = []

    def push(self, req_id: int, page: int, pages: int, data: bytes) -> bytes | None:
        """The document, if this page completes it."""
        if not 0 <= page < pages <= PAGES_MAX or len(data) > PAGE_BYTES:
            return None
        if page == 0:
            self._key, self._parts = (req_id, pages), []
        if self._key != (req_id, pages) or self._parts[page : page + 1] == [data]:
            return None
        if page != len(self._parts):
            self._key = None
            return None
        self._parts.append(data)
        if len(self._parts) < pages:
            return None
        self._key = None
        return b"".join(self._parts)
