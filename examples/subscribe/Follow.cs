// Follows the face of a session from C#. It also needs examples/unity/KouxingStream.cs:
//
// dotnet new console -o follow; replace Program.cs by both files; dotnet run [SESSION [GATEWAY]]
// (default: the newest session, ws://127.0.0.1:8080). If the gateway requires a token, put it into the
// environment variable KOUXING_GATEWAY_TOKEN.
//
// Prints the opening of the jaw, 0 to 1, 20 times per second. It uses the gateway's WebSocket. NetMQ
// also supports CURVE, but ZeroMQ has no advantage on one machine.

using System;
using System.Linq;
using System.Threading;

static class Follow
{
    static void Main(string[] arguments)
    {
        string session = arguments.ElementAtOrDefault(0) ?? "";
        string gateway = arguments.ElementAtOrDefault(1) ?? "ws://127.0.0.1:8080";
        string token = Environment.GetEnvironmentVariable("KOUXING_GATEWAY_TOKEN") ?? "";
        var avatar = new[] { new[] { "jawOpen" } }; // one mesh with one shape
        using (var stream = new KouxingStream(gateway, session, avatar, token))
            for (int tries = 0; ; tries++, Thread.Sleep(50))
            {
                if (tries == 60 && stream.Targets.Length == 0)
                    Console.Error.WriteLine(
                        $"cannot connect to the gateway at {gateway}; start it with kouxing run, and check"
                        + $" KOUXING_GATEWAY_TOKEN: {stream.ConnectionError}");
                foreach (float weight in stream.Weights) Console.WriteLine(weight.ToString("0.00"));
            }
    }
}
