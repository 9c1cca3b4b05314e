"""The commands of the command line, one file each: SUMMARY (one line), build() -> Parser, run(config) -> exit status."""
