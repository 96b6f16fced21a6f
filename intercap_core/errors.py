"""The one exception that a user's mistake or a broken input raises."""


class UserError(Exception):
    """A fault of the input, described in one sentence that a user can act on.

    The message names the file, sequence, camera and frame where known, says what was found and
    what was expected, and ends with the next step. The command line and the workflow scripts
    print it without a traceback.
    """

    def shortened(self, most: int = 2000) -> str:
        """The message, without its middle if it has more than ``most`` characters."""
        text = str(self)
        if len(text) <= most:
            return text
        return f"{text[: most // 2]} [...] {text[-most // 2 :]}"


class MissingPackage(UserError):
    """A package of an extra is not installed; the message names the extra."""
