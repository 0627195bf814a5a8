from mosa.cli.material import main

if __name__ == "__main__":
    main()
