"""Numbers and words that users give as text."""

import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.common.parsing import parse


@pytest.mark.parametrize('text, value', [('9007199254740993', 2**53 + 1), ('1e4', 10_000), ('-3', -3), ('2.0', 2)])
def test_whole_numbers(text, value):
    assert parse('seed', text, 0) == value


@pytest.mark.parametrize('text', ['1.5', 'inf', 'nan', '', 'x', '1e', '0x10'])
def test_what_is_no_whole_number(text):
    with pytest.raises(InputError, match='seed must be a whole number'):
        parse('seed', text, 0)
