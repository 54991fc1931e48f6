"""PDF files for tests, built from raw content streams."""

from io import BytesIO
from typing import Any

from pypdf import PdfWriter
from pypdf.generic import (
    ArrayObject,
    ByteStringObject,
    DecodedStreamObject,
    DictionaryObject,
    FloatObject,
    NameObject,
    NumberObject,
    PdfObject,
    TextStringObject,
)


def show_text(words: str, x: float = 72, y: float = 700, before: str = "", size: float = 12) -> str:
    """The operators that show `words`; the operators `before` set the graphics state first."""
    return f"q BT /F1 {size} Tf {before} {x} {y} Td ({words}) Tj ET Q\n"


def pdf_dictionary(**entries: PdfObject) -> DictionaryObject:
    return DictionaryObject({NameObject(f"/{name}"): value for name, value in entries.items()})


def make_pdf(*contents: str, off: str = "", password: str = "", compress: bool = False, form: str = "") -> bytes:
    """A PDF with one page for each content stream.

    Resources: font /F1, graphics states (/Ghost is transparent, /Faint for strokes, /Masked by a soft mask, /Plain,
    /Speck with a tiny font), /MC0 (a layer with the name `off` that is switched off),
    /Form (a form that draws `form`, in which /MC0 is a layer that is on), and
    colour spaces (/Dark is black with full tint, /Bleach white, /Unclear of an unknown function, /Table white at 1).
    """
    writer: Any = PdfWriter()
    font = pdf_dictionary(Type=NameObject("/Font"), Subtype=NameObject("/Type1"), BaseFont=NameObject("/Helvetica"))
    resources = pdf_dictionary(
        Font=pdf_dictionary(F1=font),
        ExtGState=pdf_dictionary(
            Ghost=pdf_dictionary(ca=FloatObject(0.0)),
            Faint=pdf_dictionary(CA=FloatObject(0.02)),
            Masked=pdf_dictionary(SMask=pdf_dictionary(S=NameObject("/Alpha"))),
            Plain=pdf_dictionary(ca=FloatObject(1.0), CA=FloatObject(1.0), SMask=NameObject("/None")),
            Speck=pdf_dictionary(Font=ArrayObject([font, FloatObject(0.5)])),
        ),
        ColorSpace=pdf_dictionary(
            Dark=_tint(1.0, 0.0),
            Bleach=_tint(0.0, 1.0),
            Unclear=_tint(1.0, 0.0, kind=4),
            Table=ArrayObject(
                [NameObject("/Indexed"), NameObject("/DeviceGray"), NumberObject(1), ByteStringObject(b"\x00\xff")]
            ),
        ),
    )
    if off:
        layer = writer._add_object(pdf_dictionary(Type=NameObject("/OCG"), Name=TextStringObject(off)))
        resources[NameObject("/Properties")] = pdf_dictionary(MC0=layer)
        start = pdf_dictionary(OFF=ArrayObject([layer]))
        writer._root_object[NameObject("/OCProperties")] = pdf_dictionary(OCGs=ArrayObject([layer]), D=start)
    if form:
        drawn = DecodedStreamObject()
        drawn.set_data(form.encode("latin-1"))
        box = ArrayObject([FloatObject(edge) for edge in (0, 0, 612, 792)])
        drawn.update(pdf_dictionary(Type=NameObject("/XObject"), Subtype=NameObject("/Form"), BBox=box))
        shown = writer._add_object(pdf_dictionary(Type=NameObject("/OCG"), Name=TextStringObject("shown")))
        drawn[NameObject("/Resources")] = pdf_dictionary(
            Font=pdf_dictionary(F1=font), Properties=pdf_dictionary(MC0=shown)
        )
        resources[NameObject("/XObject")] = pdf_dictionary(Form=writer._add_object(drawn))
    for content in contents:
        page = writer.add_blank_page(width=612, height=792)
        page[NameObject("/Resources")] = resources
        stream = DecodedStreamObject()
        stream.set_data(content.encode("latin-1"))
        page[NameObject("/Contents")] = writer._add_object(stream.flate_encode() if compress else stream)
    if password:
        writer.encrypt(password, algorithm="RC4-128")
    out = BytesIO()
    writer.write(out)
    return out.getvalue()


def _tint(none: float, full: float, kind: int = 2) -> ArrayObject:
    """A colour space of one colorant: the grey values without and with all of it, by a function of the type `kind`."""
    function = pdf_dictionary(
        FunctionType=NumberObject(kind),
        Domain=ArrayObject([NumberObject(0), NumberObject(1)]),
        C0=ArrayObject([FloatObject(none)]),
        C1=ArrayObject([FloatObject(full)]),
        N=NumberObject(1),
    )
    return ArrayObject([NameObject("/Separation"), NameObject("/Spot"), NameObject("/DeviceGray"), function])
