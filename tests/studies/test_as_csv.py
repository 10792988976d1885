"""Tables of pages as data."""

from studies.as_csv import cells, store


def test_tables_as_data(tmp_path):
    """A page's table is a file of its name; of two, each has its heading's."""
    page = tmp_path / 'page.md'
    page.write_text('# Times\n\n| a | b, c |\n|---|---:|\n| x | 2.0 |\n')
    assert (
        store(page, tmp_path) == [tmp_path / 'page.csv'] and (tmp_path / 'page.csv').read_text() == 'a,"b, c"\nx,2.0\n'
    )
    page.write_text(page.read_text() + '\n## Two Errors\n\n| d |\n|---|\n| – |\n')
    assert cells(page.read_text())['Two Errors'] == [['d'], ['–']]
    assert [path.name for path in store(page, tmp_path)] == ['page_times.csv', 'page_two_errors.csv']
