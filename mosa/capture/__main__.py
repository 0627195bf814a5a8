from mosa.commands.capture import main

if __name__ == "__main__":
    main()
