"""The error of the commands themselves."""


class UsageError(ValueError):
    """What was asked for does not fit the files given; the message says what would."""
