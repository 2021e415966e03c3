"""The library's tasks: goals, reward terms, start states and reports."""
