"""What people gave and a command cannot use. The text is one line for whoever gave it; exit status 2."""


class Refusal(Exception):
    """A file, folder or argument that cannot be used."""


class BadRequest(Refusal):
    """An argument that contradicts the rest or cannot be shown."""
