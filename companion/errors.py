"""Errors that the user can mend: one line, no traceback, exit code 2."""


class UserError(Exception):
    """Bad input: a file, a value or a call. The message names the thing, the value and the limit."""
