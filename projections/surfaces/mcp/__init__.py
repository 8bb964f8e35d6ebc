"""The map for agents: a server of the Model Context Protocol (extra ``mapfold[mcp]``)."""
