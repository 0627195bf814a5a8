from mosa.commands.environments import main

if __name__ == "__main__":
    main()
