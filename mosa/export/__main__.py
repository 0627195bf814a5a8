from mosa.cli.export_law import main

if __name__ == "__main__":
    main()
