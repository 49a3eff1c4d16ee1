from .cli import commands as commands
