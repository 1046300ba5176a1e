"""The command ``learnnorm``: one module a command."""
