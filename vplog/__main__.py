from vplog.cli import main

main()
