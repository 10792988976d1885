"""Messages of one line, whatever they quote."""

import pickle

import pytest

from lingo_mi.common.errors import InputError, shown


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
    message = str(InputError(text))
    assert len(message) < 300 and message.isprintable() and len((message + '.').splitlines()) == 1
    message.encode('utf-8')


def test_where_and_mend_stay():
    message = str(InputError('scan.yml: ' + 'x' * 1000 + '; correct it'))
    assert message.startswith('scan.yml: x') and message.endswith('; correct it')
    assert str(InputError('a short one')) == 'a short one'
    assert str(pickle.loads(pickle.dumps(InputError(message)))) == message


def test_shown():
    assert shown([1, 'a']) == "[1, 'a']" and shown(10**10_000) == 'that int' and len(shown('x' * 10**6)) == 80
    nested = []
    for _ in range(100_000):
        nested = [nested]
    assert shown(nested) == 'that list'
