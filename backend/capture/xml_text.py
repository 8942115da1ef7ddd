"""XML from other programs."""

from __future__ import annotations

from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat


def parse_xml(text: str | bytes) -> Element:
    """Parse XML without a DTD, since its entities may expand without bound or name other files.

    Raises:
        ValueError: It is invalid or contains a DTD; the message is the end of a sentence.
    """
    builder, parser = TreeBuilder(), expat.ParserCreate()

    def refuse(*_: object) -> None:
        raise ValueError("contains a DTD, which is not accepted")

    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler = lambda tag, attributes: builder.start(tag, attributes) and None
    parser.EndElementHandler = lambda tag: builder.end(tag) and None
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise ValueError(f"is not valid XML ({error})") from error
    return builder.close()
