from mosa.cli.capture import main

if __name__ == "__main__":
    main()
