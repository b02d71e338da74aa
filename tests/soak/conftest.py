"""What soak tests do not share with others: tables that are kept for a session would fill the memory in hours."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def tables_of_a_module():
    """Keep the tables of no spectrum longer than its BSDFs."""


@pytest.fixture(scope="session", autouse=True)
def results_of_a_session():
    """Compute E anew."""
