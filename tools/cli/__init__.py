"""The `hearthlog` command line, one module per group of subcommands."""
