"""Messages of one line, whatever they quote."""

import pickle

import pytest

from lingo_mi.common.errors import InputError, brief, shown


@pytest.mark.parametrize(
    'text',
    [
        'a.yml: bad\n\tline two\r\n  line three',
        'start ' + 'x' * 100_000 + ' end',
        '\0\x1b[31m\u2028\udcff' * 1000,
        '\U0001f600' * 400,
        ' ' * 5000,
        '',
    ],
)
def test_a_message_is_one_printable_line(text):
    for message in str(InputError(text)), brief(text), brief(InputError(text)):
        assert message.isprintable() and len((message + '.').splitlines()) == 1
        message.encode('utf-8')
    assert len(brief(text)) < 300 and len(brief(InputError(text))) < 300


def test_where_and_the_remedy_stay():
    error = InputError('scan.yml: ' + 'x' * 1000 + '; correct it')
    assert str(error) == 'scan.yml: ' + 'x' * 1000 + '; correct it'
    assert brief(error).startswith('scan.yml: x') and brief(error).endswith('; correct it')
    assert str(InputError('a short one')) == brief('a short one') == 'a short one'
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_shown():
    assert shown([1, 'a']) == "[1, 'a']" and shown(10**10_000) == 'that int' and len(shown('x' * 10**6)) == 80
    nested = []
    for _ in range(100_000):
        nested = [nested]
    assert shown(nested) == 'that list'
