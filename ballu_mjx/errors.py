"""The one exception that users are meant to see."""


class InputError(Exception):
    """Something that the user gave cannot be used.

    The message is one sentence that names the file, the place in it and the mend; commands print it alone and exit
    with status 2.
    """
