from vplog.cli.main import main

main()
