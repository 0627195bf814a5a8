from mosa.cli.environments import main

if __name__ == "__main__":
    main()
