"""The one exception that users cause and can mend."""


class UserError(Exception):
    """Bad input. Its text is one line: what is wrong and what to do. The command line prints it and exits with 2."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))
