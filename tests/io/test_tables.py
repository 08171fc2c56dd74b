"""Tables: what the one writer writes, the one reader reads back; Excel workbooks are read as their CSV would be."""

import csv
import io
import zipfile
from pathlib import Path

import pytest

from shapespace.cohort.table import Label, read_labels, read_table
from shapespace.errors import FileFormatError
from shapespace.io.tables.table_io import CHECKSUM, checked_table_text, table_rows, table_text
from shapespace.io.tables.workbook import sheet_rows

HARMFUL = ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(1)", "\t=1", "\r=1", "'=1", "''+x", "-", '=LINK("x","y")']
PLAIN = ["", "a", "-1.5", "+3", "-1e-05", "-inf", "a=b", "'quoted'", "don't", "ä", 'say "a, b"', "two\nlines"]


@pytest.mark.parametrize("checked", [False, True])
@pytest.mark.parametrize("text", HARMFUL + PLAIN)
def test_text_comes_back_as_it_was_and_no_cell_starts_as_a_formula(text: str, checked: bool) -> None:
    header = ("scan", text or "x", CHECKSUM) if checked else ("scan", text or "x")
    made = checked_table_text(header, [(text, 1.5, "")]) if checked else table_text(header, [(text, 1.5)])
    heads, row = list(table_rows(made.encode()))
    assert heads[1] == (text or "x").strip() and row[0] == text and row[1] == "1.5"
    for cell in next(iter(csv.reader(io.StringIO(made, newline="")))):
        assert cell[:1] not in tuple("=+-@\t\r") or text in PLAIN


def test_ordinary_tables_keep_their_bytes_and_numbers_are_never_escaped() -> None:
    rows = [("a", -1.5, 3, None, "-2.5e-3"), ("b c", float("-inf"), -7, "", "x-y")]
    plain = io.StringIO()
    writer = csv.writer(plain, lineterminator="\n")
    writer.writerows([("scan", "v", "n", "o", "t"), *rows])
    assert table_text(("scan", "v", "n", "o", "t"), rows) == plain.getvalue()


CONTENT = '<?xml version="1.0"?><Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types"/>'
MAIN = 'xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"'
RELATED = 'xmlns:r="http://schemas.openxmlformats.org/officeDocument/2006/relationships"'


def workbook(sheet: str, strings: str = "", *, styles: str = "", extra: dict[str, str] | None = None) -> bytes:
    """The bytes of a workbook as Excel writes it, of one sheet with the XML `sheet` of its rows."""
    parts = {
        "[Content_Types].xml": CONTENT,
        "xl/workbook.xml": f'<workbook {MAIN} {RELATED}><sheets><sheet name="people" sheetId="1" r:id="rId1"/></sheets>'
        "</workbook>",
        "xl/_rels/workbook.xml.rels": '<Relationships xmlns="x">'
        '<Relationship Id="rId1" Target="worksheets/sheet1.xml"/></Relationships>',
        "xl/worksheets/sheet1.xml": f"<worksheet {MAIN}><sheetData>{sheet}</sheetData></worksheet>",
        "xl/sharedStrings.xml": f"<sst {MAIN}>{strings}</sst>",
        "xl/styles.xml": f"<styleSheet {MAIN}>{styles}</styleSheet>",
        **(extra or {}),
    }
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in parts.items():
            archive.writestr(name, text)
    return out.getvalue()


STRINGS = (
    "<si><t>Specimen</t></si><si><t>sex</t></si>"
    "<si><r><t>Mü</t></r><r><t>ller</t></r><rPh sb='0' eb='1'><t>x</t></rPh></si>"
    "<si><t xml:space='preserve'>f </t></si>"
)
SHEET = (
    '<row r="2"><c r="B2" t="s"><v>0</v></c><c r="C2" t="s"><v>1</v></c><c r="D2" t="inlineStr"><is><t>age</t></is></c>'
    '<c t="str"><v>visit</v></c><c r="F2" t="str"><v>smokes</v></c></row>'
    '<row r="4"><c r="B4" t="s"><v>2</v></c><c r="C4" t="s"><v>3</v></c><c r="D4"><v>20.5</v></c>'
    '<c r="E4" s="1"><v>44197</v></c><c r="F4" t="b"><v>1</v></c></row>'
    '<row r="5"><c r="B5" t="str"><v>b</v></c><c r="D5" t="e"><v>#N/A</v></c><c r="E5" s="2"><v>44197.5</v></c></row>'
)
STYLES = (
    '<numFmts><numFmt numFmtId="164" formatCode="[$-407]d/mm/yyyy hh:mm"/></numFmts><cellStyleXfs><xf numFmtId="14"/>'
    '</cellStyleXfs><cellXfs><xf numFmtId="0"/><xf numFmtId="14"/><xf numFmtId="164"/></cellXfs>'
)


def test_a_workbook_is_read_as_the_table_that_it_shows(tmp_path: Path) -> None:
    path = tmp_path / "people.xlsx"
    path.write_bytes(workbook(SHEET, STRINGS, styles=STYLES))
    table = read_table(path)
    assert table.rows == ("Müller", "b")
    assert dict(table.columns) == {
        "sex": ("f", ""), "age": ("20.5", ""), "visit": ("2021-01-01", "2021-01-01 12:00:00"), "smokes": ("TRUE", ""),
    }  # fmt: skip


def test_labels_are_what_compare_takes(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_bytes("ID;age;group \r\na;1,5;wild\r\nb;2;wild \r\nc;3;lab\r\n".encode("utf-16"))
    expected = (Label("wild"), Label("wild"), Label("lab"))
    assert read_labels(tmp_path / "t.csv").labels == expected
    (tmp_path / "t.csv").write_text("specimen,age,habitat\na,1,wild\nb,2,wild\nc,3,lab\n")
    assert read_labels(tmp_path / "t.csv", of_any=True).labels == expected
    with pytest.raises(FileFormatError, match="no table of labels"):
        read_labels(tmp_path / "t.csv")


HEAD = '<row r="1"><c r="A1" t="str"><v>id</v></c><c r="B1" t="str"><v>x</v></c></row>'


@pytest.mark.parametrize(
    ("sheet", "fault"),
    [
        (f'{HEAD}<row r="2"><c r="A2" t="s"><v>{"9" * 5000}</v></c></row>', "no shared string '99999"),
        (f'{HEAD}<row r="2"><c r="A2" t="s"><v>7</v></c></row>', "no shared string '7'"),
        (f'{HEAD}<row r="2"><c r="A2" t="s"><v>-1</v></c></row>', "no shared string '-1'"),
        (f'{HEAD}<row r="2"><c r="A2" t="e"><v>#DIV/0!</v></c></row>', "has the error #DIV/0!"),
        (f'{HEAD}<row r="2"><c r="ZZZ2" t="str"><v>1</v></c></row>', "more columns than a sheet can have"),
        (
            f'{HEAD}<row r="2"><c r="A2" t="str"><v>a</v></c><c r="C2"><v>1</v></c></row>',
            "has a cell outside its table",
        ),
        (f'{HEAD}<row r="2"><c', "damaged"),
    ],
)
def test_a_workbook_that_cannot_be_is_refused_in_one_sentence(tmp_path: Path, sheet: str, fault: str) -> None:
    (tmp_path / "t.xlsx").write_bytes(workbook(sheet))
    with pytest.raises(FileFormatError, match=fault) as error:
        read_table(tmp_path / "t.xlsx")
    assert str(error.value).count(";") == 1


def test_a_workbook_that_unpacks_to_much_is_refused_before_it_does() -> None:
    bomb = workbook(HEAD, extra={"xl/media/bomb": "0" * 2**27})
    assert len(bomb) < 2**18
    with pytest.raises(ValueError, match="unpack to far more"):
        sheet_rows(bomb)
    # A long string may stand in many cells.
    many = "".join(f'<row r="{k}"><c r="A{k}" t="s"><v>0</v></c></row>' for k in range(1, 3000))
    with pytest.raises(ValueError, match="more cells or text"):
        sheet_rows(workbook(many, f"<si><t>{'x' * 30000}</t></si>", extra={"noise": str(list(range(40_000)))}))
    entities = '<!DOCTYPE a [<!ENTITY b "bbbb">]><worksheet>&b;</worksheet>'
    with pytest.raises(ValueError, match=r"document type|damaged"):
        sheet_rows(workbook("", extra={"xl/worksheets/sheet1.xml": entities}))
