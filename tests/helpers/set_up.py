"""A set-up whose commands are not run."""

from pathlib import Path

from bootstrap import Setup


class Recorded(Setup):
    """A set-up that runs nothing but says which commands it would have run."""

    def __init__(self, root: Path, fail: str = '', code: int = 1, printed: str = 'it broke'):
        super().__init__(root)
        self.fail, self.code, self.printed = fail, code, printed
        self.stages: list[str] = []

    def call(self, stage, command, variables=None, secret=False) -> tuple[int, str]:
        by_pip = stage.startswith('packages') and command[1:3] == ['-m', 'pip']
        stage += ' by pip' if by_pip else ''
        self.stages.append(stage)
        if stage == 'environment':
            self.site.mkdir(parents=True)
            self.python.parent.mkdir()
            self.python.touch()
            (self.venv / 'pyvenv.cfg').touch()
            (self.python.parent / 'pip').write_text(f'#!{self.python}\n')
        if stage == 'workspace':
            target = self.venv / 'lib' / 'codetr_ros' / 'codetr'
            target.parent.mkdir(parents=True, exist_ok=True)
            target.touch()
        if stage in self.fail.split(','):
            (self.site / 'half').touch()
            return self.code, self.printed
        return 0, ''


PACKAGES = ['installers', 'options', 'packages', 'packages-bare']
BY_PIP = ['packages by pip', 'packages-bare by pip']
EVERYTHING = ['environment', *PACKAGES, 'workspace', 'check']
