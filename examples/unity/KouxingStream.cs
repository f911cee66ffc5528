// Follows a live session over the gateway's WebSocket: weights of shapes, in plain C#
// (.NET Standard 2.1: Unity 2021 or newer, .NET 5 or newer) without dependencies.

using System;
using System.Collections.Generic;
using System.IO;
using System.Net.WebSockets;
using System.Text;
using System.Text.RegularExpressions;
using System.Threading;
using System.Threading.Tasks;

/// <summary>The current face: the names of the shapes and their weights, 0 to 1.</summary>
public sealed class KouxingStream : IDisposable
{
    const int WeightsOfFrame = 4, WeightsAtRest = 5; // types of binary messages, proto/GATEWAY.md
    const int HeaderBytes = 16;
    const int RetryMs = 1000;
    static readonly Regex Quoted = new Regex("\"([^\"]*)\"");

    readonly Uri _url;
    readonly CancellationTokenSource _stop = new CancellationTokenSource();

    /// <summary>Names in the order of the weights; empty until connected.</summary>
    public IReadOnlyList<string> Names { get; private set; } = Array.Empty<string>();

    /// <summary>Weights of the newest face. The array is replaced, never changed, so any thread may read it.</summary>
    public float[] Weights { get; private set; } = Array.Empty<float>();

    /// <summary>Follow a session until disposed; an empty name means the newest. Shapes: arkit, oculus or vrm.</summary>
    public KouxingStream(string gateway = "ws://127.0.0.1:8080", string session = "", string shapes = "arkit")
    {
        _url = new Uri(gateway + "/viewer?shapes=" + shapes + "&session=" + Uri.EscapeDataString(session));
        _ = Task.Run(RunAsync);
    }

    public void Dispose() => _stop.Cancel();

    async Task RunAsync()
    {
        while (!_stop.IsCancellationRequested)
        {
            try
            {
                using (var socket = new ClientWebSocket())
                {
                    await socket.ConnectAsync(_url, _stop.Token);
                    await ReceiveAsync(socket);
                }
            }
            catch (WebSocketException) { } // the gateway is not running
            catch (OperationCanceledException) { return; }
            await Task.Delay(RetryMs);
        }
    }

    async Task ReceiveAsync(ClientWebSocket socket)
    {
        var buffer = new ArraySegment<byte>(new byte[4096]);
        while (socket.State == WebSocketState.Open)
        {
            var message = new MemoryStream();
            WebSocketReceiveResult result;
            do
            {
                result = await socket.ReceiveAsync(buffer, _stop.Token);
                message.Write(buffer.Array, 0, result.Count);
            } while (!result.EndOfMessage);
            if (result.MessageType == WebSocketMessageType.Text) ReadText(Encoding.UTF8.GetString(message.ToArray()));
            if (result.MessageType == WebSocketMessageType.Binary) ReadBinary(message.ToArray());
        }
    }

    // {"type": "shapes", "set": "arkit", "names": ["browDownLeft", ...]}
    void ReadText(string text)
    {
        int names = text.IndexOf("\"names\"", StringComparison.Ordinal);
        if (!text.Contains("\"shapes\"") || names < 0) return;
        var list = new List<string>();
        foreach (Match match in Quoted.Matches(text, text.IndexOf('[', names))) list.Add(match.Groups[1].Value);
        Names = list;
    }

    void ReadBinary(byte[] message)
    {
        if (message[0] != WeightsOfFrame && message[0] != WeightsAtRest) return;
        var weights = new float[(message.Length - HeaderBytes) / sizeof(float)];
        Buffer.BlockCopy(message, HeaderBytes, weights, 0, weights.Length * sizeof(float));
        Weights = weights;
    }
}
