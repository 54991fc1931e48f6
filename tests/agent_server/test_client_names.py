"""Names of MCP clients as authors."""

from dualbrain.agent_server.client_names import FURTHER, MAX_LENGTH, MAX_NAMES, UNNAMED, ClientNames


def test_a_client_has_one_name():
    names = ClientNames()
    assert names.name("desk agent") == names.name("desk agent") == "mcp:desk agent"
    assert names.name("") == UNNAMED


def test_names_are_printable_and_short():
    name = ClientNames().name("\u202e" + "a" * 500)
    assert name.isascii()
    assert len(name) <= MAX_LENGTH + 4


def test_a_client_that_changes_its_name_gets_a_bounded_number_of_authors():
    names = ClientNames()
    given = {names.name(f"agent {number}") for number in range(200)}
    assert len(given) == MAX_NAMES + 1
    assert FURTHER in given
    assert names.name("agent 0") == "mcp:agent 0"
