"""PDF files of words, drawings and pictures: standard fonts, nothing that a library is needed for (ISO 32000-1).

Coordinates are PDF's: points of 1/72 inch, y up.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from xml.etree import ElementTree

import cv2
import numpy as np

MM = 72.0 / 25.4
"""Points a millimetre."""
A4 = (210.0 * MM, 297.0 * MM)
_ROUND = 0.5523
"""Of the radius: control points of four Bezier curves that make a circle, to 0.03 % of it."""
_WIDTHS = (
    *(278, 278, 355, 556, 556, 889, 667, 191, 333, 333, 389, 584, 278, 333, 278, 278),
    *(556, 556, 556, 556, 556, 556, 556, 556, 556, 556, 278, 278, 584, 584, 584, 556),
    *(1015, 667, 667, 722, 722, 667, 611, 778, 722, 278, 500, 667, 556, 833, 722, 778),
    *(667, 778, 722, 667, 611, 722, 667, 944, 667, 667, 611, 278, 278, 278, 469, 556),
    *(333, 556, 556, 500, 556, 556, 278, 556, 556, 222, 222, 500, 222, 833, 556, 556),
    *(556, 556, 333, 500, 278, 556, 500, 722, 500, 500, 500, 334, 260, 334, 584),
)
"""Of Helvetica's characters from space to ~, in thousandths of the size (its public metrics)."""
_BOLD = 1.08
"""How much wider Helvetica-Bold is, at most on words; chosen."""
_JPEG_QUALITY = 85


@dataclass
class Page:
    """What is drawn on one sheet, and the pictures (JPEG: data, width px, height px) that it shows."""

    width: float
    height: float
    content: list[str] = field(default_factory=list)
    pictures: list[tuple[bytes, int, int]] = field(default_factory=list)

    def text(self, x: float, y: float, words: str, size: float, *, bold: bool = False, colour: str = "#000000") -> None:
        """A line of words from its base line's left end."""
        font = "B" if bold else "F"
        self.content.append(f"BT {_rgb(colour)} rg /{font} {size:g} Tf {x:.2f} {y:.2f} Td ({_escaped(words)}) Tj ET")

    def rect(self, x: float, y: float, width: float, height: float, fill: str) -> None:
        self.content.append(f"{_rgb(fill)} rg {x:.2f} {y:.2f} {width:.2f} {height:.2f} re f")

    def picture(self, jpeg: bytes, size_px: tuple[int, int], x: float, y: float, width: float, height: float) -> None:
        """A JPEG with its lower left corner at x, y."""
        self.pictures.append((jpeg, *size_px))
        name = f"I{len(self.pictures)}"
        self.content.append(f"q {width:.2f} 0 0 {height:.2f} {x:.2f} {y:.2f} cm /{name} Do Q")

    def svg(self, drawing: str, x: float, top: float, scale: float) -> None:
        """A drawing of drawing.py's kind with its upper left corner at x, top; what others draw is passed over."""
        self.content.append(f"q {scale:.5f} 0 0 {-scale:.5f} {x:.2f} {top:.2f} cm 1 j")
        for node in ElementTree.fromstring(drawing):
            self.content.extend(_shape(node))
        self.content.append("Q")


def width_of(words: str, size: float, bold: bool = False) -> float:
    """Of a line of Helvetica; characters beyond ASCII count as a digit."""
    units = sum(_WIDTHS[ord(c) - 32] if 32 <= ord(c) < 127 else 556 for c in words)
    return units * size / 1000.0 * (_BOLD if bold else 1.0)


def wrapped(words: str, size: float, room: float, bold: bool = False) -> list[str]:
    """Lines that fit into a width; a word that is longer is cut."""
    lines = [""]
    for word in words.split():
        joined = f"{lines[-1]} {word}".strip()
        if width_of(joined, size, bold) <= room:
            lines[-1] = joined
            continue
        if lines[-1]:
            lines.append("")
        for c in word:
            if width_of(lines[-1] + c, size, bold) > room and lines[-1]:
                lines.append("")
            lines[-1] += c
    return lines


def jpeg_of(picture: bytes, most_px: int) -> tuple[bytes, tuple[int, int]] | None:
    """A PNG or JPEG made anew as a JPEG whose longer side is at most so long, and its width and height; None where it
    is no picture. What a telephone wrote beside the pixels, such as the place, is not in it."""
    image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR) if picture else None
    if image is None:
        return None
    share = most_px / max(image.shape[:2])
    if share < 1.0:
        image = cv2.resize(image, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
    return bytes(data), (image.shape[1], image.shape[0])


def circle(x: float, y: float, r: float, digits: int = 5) -> str:
    """A path round a place."""
    k = _ROUND * r
    curves = (
        (x + r, y + k, x + k, y + r, x, y + r),
        (x - k, y + r, x - r, y + k, x - r, y),
        (x - r, y - k, x - k, y - r, x, y - r),
        (x + k, y - r, x + r, y - k, x + r, y),
    )
    parts = [f"{' '.join(f'{v:.{digits}f}' for v in c)} c" for c in curves]
    return f"{x + r:.{digits}f} {y:.{digits}f} m " + " ".join(parts) + " h"


def file(pages: Sequence[Page], *, packed: bool = True) -> bytes:
    """The whole file; it is printed at its own size."""
    fonts = "/F 3 0 R /B 4 0 R"
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"",  # the pages, when their numbers are known
        *(
            b"<< /Type /Font /Subtype /Type1 /BaseFont /%b /Encoding /WinAnsiEncoding >>" % name
            for name in (b"Helvetica", b"Helvetica-Bold")
        ),
    ]
    kids = []
    for page in pages:
        names = []
        for i, (data, width, height) in enumerate(page.pictures, 1):
            head = f"/Type /XObject /Subtype /Image /Width {width} /Height {height} /ColorSpace /DeviceRGB"
            objects.append(_stream(data, f"{head} /BitsPerComponent 8 /Filter /DCTDecode"))
            names.append(f"/I{i} {len(objects)} 0 R")
        stream = "\n".join(page.content).encode("cp1252", "replace")
        objects.append(_stream(zlib.compress(stream), "/Filter /FlateDecode") if packed else _stream(stream))
        resources = f"<< /Font << {fonts} >> /XObject << {' '.join(names)} >> >>"
        shown = f"/MediaBox [0 0 {page.width:.4f} {page.height:.4f}] /Contents {len(objects)} 0 R"
        objects.append(f"<< /Type /Page /Parent 2 0 R {shown} /Resources {resources} >>".encode())
        kids.append(f"{len(objects)} 0 R")
    objects[1] = f"<< /Type /Pages /Kids [{' '.join(kids)}] /Count {len(kids)} >>".encode()
    return _numbered(objects)


def _stream(data: bytes, head: str = "") -> bytes:
    return b"<< %b /Length %d >>\nstream\n%b\nendstream" % (head.encode(), len(data), data)


def _numbered(objects: Sequence[bytes]) -> bytes:
    """Objects from 1 on with the table of where each begins."""
    out, begins = b"%PDF-1.7\n", []
    for i, body in enumerate(objects, 1):
        begins.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (i, body)
    table = b"".join(b"%010d 00000 n \n" % b for b in begins)
    count = len(objects) + 1
    end = b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (count, len(out))
    return out + b"xref\n0 %d\n0000000000 65535 f \n" % count + table + end


def _escaped(words: str) -> str:
    return re.sub(r"([\\()])", r"\\\1", words)


def _rgb(colour: str) -> str:
    return " ".join(f"{int(colour[i : i + 2], 16) / 255:.3f}" for i in (1, 3, 5))


def _shape(node: ElementTree.Element) -> list[str]:
    """PDF's words for one element."""
    kind, get = node.tag.rpartition("}")[2], node.get
    fill, stroke = get("fill", "none"), get("stroke", "none")
    paint = {(True, True): "B", (True, False): "f", (False, True): "S"}.get((fill != "none", stroke != "none"), "n")
    colours = [f"{_rgb(c)} {word}" for c, word in ((fill, "rg"), (stroke, "RG")) if c != "none"]
    colours.append(f"{get('stroke-width', '1')} w [{get('stroke-dasharray', '')}] 0 d")
    if kind in ("polyline", "polygon"):
        points = [p.replace(",", " ") for p in get("points", "").split()]
        path = " ".join([f"{points[0]} m", *(f"{p} l" for p in points[1:]), *(["h"] if kind == "polygon" else [])])
    elif kind == "circle":
        path = circle(float(get("cx", "0")), float(get("cy", "0")), float(get("r", "0")), 2)
    elif kind == "rect":
        path = f"{get('x', '0')} {get('y', '0')} {get('width')} {get('height')} re"
    elif kind == "text":
        return [*colours[:1], _words(node)]
    else:
        return []
    return [*colours, f"{path} {paint}"]


def _words(node: ElementTree.Element) -> str:
    text, size = node.text or "", float(node.get("font-size", "12"))
    x, y = float(node.get("x", "0")), float(node.get("y", "0"))
    back = {"middle": 0.5, "end": 1.0}.get(node.get("text-anchor", ""), 0.0) * width_of(text, size)
    # y points down in drawings, so letters are turned over again
    turn = f"0 -1 -1 0 {x:.2f} {y + back:.2f}" if node.get("transform") else f"1 0 0 -1 {x - back:.2f} {y:.2f}"
    return f"BT /F {size:g} Tf {turn} Tm ({_escaped(text)}) Tj ET"
