"""What is raised where a scene, its cameras or its photographs cannot be used."""


class SceneError(ValueError):
    """The scene cannot be used; the message is one sentence: what was expected, what was found and what to do.

    Names from files stand in the sentence, so that line breaks and control characters in it become question marks.
    """

    def __init__(self, sentence: str) -> None:
        super().__init__("".join(character if character.isprintable() else "?" for character in sentence))
