"""Tables in Markdown and their places in documents, and which documents the commands update."""

import pytest

from helpers.script import run
from lingo_mi.common.errors import InputError
from lingo_mi.validation.markdown import check_places, insert, insert_into, table

TEXT = 'a\n<!-- table x -->\nold\nrows\n<!-- end x -->\nb\n'


def test_table():
    columns = [('a', lambda r: r['a']), ('b', lambda r: f'{r["b"]:.1f}')]
    assert table(columns, [dict(a='x', b=2)], 'c') == '| c | b |\n|---|---:|\n| x | 2.0 |'


def test_tables_find_their_place():
    new = insert(TEXT, dict(x='| new |'))
    assert new == 'a\n<!-- table x -->\n| new |\n<!-- end x -->\nb\n'
    assert insert(new, dict(x='| new |')) == new
    with pytest.raises(InputError, match='no place for the table y'):
        insert(TEXT, dict(y=''))


def test_in_a_file(tmp_path):
    document = tmp_path / 'a.md'
    document.write_text(TEXT)
    check_places(document, ['x'])
    assert document.read_text() == TEXT
    insert_into(document, dict(x='new'))
    assert document.read_text() == insert(TEXT, dict(x='new'))
    with pytest.raises(InputError, match='no place for the table y'):
        check_places(document, ['x', 'y'])
    with pytest.raises(InputError, match='no such file'):
        check_places(tmp_path / 'b.md', ['x'])


@pytest.mark.parametrize('name, command', [('accuracy', 'accuracy'), ('effects', 'studies.effects')])
@pytest.mark.parametrize('option', ['--docs', '--document'])
def test_a_document_without_its_places_is_refused_before_measuring(name, command, option, tmp_path):
    (tmp_path / f'{name}.md').write_text('nothing')
    path = {'--docs': tmp_path, '--document': tmp_path / f'{name}.md'}[option]
    code, out, err = run(command, option, path, '--out', tmp_path / 'out')
    assert code == 2 and err.startswith('error: ') and 'no place for the table' in err and err.count('\n') == 1
    code, out, err = run(command, option, tmp_path / 'absent', '--out', tmp_path / 'out')
    assert code == 2 and err.startswith('error: ') and err.count('\n') == 1
    assert not out and not (tmp_path / 'out').exists()
    code, out, err = run(command, option, path, '--out', tmp_path)
    assert code == 2 and 'could overwrite' in err and err.count('\n') == 1
