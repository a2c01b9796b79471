"""The one error that a user can cause and therefore can repair.

Everything else that goes wrong is a broken promise of ours: an `assert` or a plain traceback.
"""


class InputError(Exception):
    """Something handed to a program is wrong: say what, where, and one thing to do about it.

    `code` is stable (`CAP-003`), so that it can be searched for and tested.
    """

    def __init__(self, code: str, what: str, where: str = "", remedy: str = "") -> None:
        super().__init__(code, what, where, remedy)
        self.code, self.what, self.where, self.remedy = code, what, where, remedy

    def __str__(self) -> str:
        place = f"{self.where}: " if self.where else ""
        advice = f"\n  -> {self.remedy}" if self.remedy else ""
        return f"{self.code} {place}{self.what}{advice}"
