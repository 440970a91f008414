"""What the tests of pages share."""

from tests.people.browser import browser

__all__ = ["browser"]
