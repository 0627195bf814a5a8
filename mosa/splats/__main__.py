from mosa.cli.splats import main

if __name__ == "__main__":
    main()
