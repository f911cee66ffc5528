// Follows the face of a session from C#, with examples/unity/KouxingStream.cs beside it:
//
// dotnet new console -o follow; copy both files there in place of Program.cs; dotnet run [SESSION [GATEWAY]]
// (default: the newest session, ws://127.0.0.1:8080)
//
// Prints 20 times a second how far the jaw opens, 0 to 1. It speaks with the gateway: NetMQ knows
// CURVE as well, but ZeroMQ gains nothing on one machine.

using System;
using System.Linq;
using System.Threading;

static class Follow
{
    static void Main(string[] arguments)
    {
        string session = arguments.ElementAtOrDefault(0) ?? "";
        string gateway = arguments.ElementAtOrDefault(1) ?? "ws://127.0.0.1:8080";
        using (var stream = new KouxingStream(gateway, session))
            for (; ; Thread.Sleep(50))
            {
                var (names, weights) = (stream.Names, stream.Weights);
                int jaw = names.ToList().IndexOf("jawOpen");
                if (jaw >= 0 && jaw < weights.Length) Console.WriteLine(weights[jaw].ToString("0.00"));
            }
    }
}
