// Follows a live session over the gateway's WebSocket: weights of shapes, in plain C#
// (.NET Standard 2.1: Unity 2021 or newer, .NET 5 or newer) without dependencies.

using System;
using System.Collections.Generic;
using System.IO;
using System.Linq;
using System.Net.WebSockets;
using System.Text;
using System.Text.RegularExpressions;
using System.Threading;
using System.Threading.Tasks;

/// <summary>The current face of an avatar: which of its shapes move, and their weights, 0 to 1.</summary>
public sealed class KouxingStream : IDisposable
{
    const int WeightsOfFrame = 4, WeightsAtRest = 5; // types of binary messages, proto/GATEWAY.md
    const int HeaderBytes = 16;
    const int RetryMs = 1000;
    static readonly Regex Target = new Regex(@"\[(\d+),(\d+)\]");
    static readonly Regex ErrorText = new Regex(@"""text"":""((?:[^""\\]|\\.)*)""");

    readonly Uri _url;
    readonly byte[] _avatar;
    readonly CancellationTokenSource _stop = new CancellationTokenSource();

    /// <summary>What each weight moves: a mesh and a shape within it, counted from 0.</summary>
    public int[][] Targets { get; private set; } = Array.Empty<int[]>();

    /// <summary>Weights of the newest face. The array is replaced, never changed, so any thread may read it.</summary>
    public float[] Weights { get; private set; } = Array.Empty<float>();

    /// <summary>Why the avatar cannot speak; empty if it can.</summary>
    public string Error { get; private set; } = "";

    /// <summary>Why the last connection failed; empty while the stream is connected.</summary>
    public string ConnectionError { get; private set; } = "";

    /// <summary>Follow a session until disposed; an empty name means the newest.</summary>
    /// <param name="meshes">Names of the shapes of each mesh: ARKit's, Oculus', VRM's, or other programs' names.</param>
    /// <param name="token">The gateway's token, if it requires one.</param>
    public KouxingStream(
        string gateway, string session, IEnumerable<IEnumerable<string>> meshes, string token = "")
    {
        string query = "?session=" + Uri.EscapeDataString(session) + "&token=" + Uri.EscapeDataString(token);
        _url = new Uri(gateway.TrimEnd('/') + "/viewer" + query);
        var lists = meshes.Select(names => "[" + string.Join(",", names.Select(Quote)) + "]");
        _avatar = Encoding.UTF8.GetBytes("{\"avatar\": [" + string.Join(",", lists) + "]}");
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
                    ConnectionError = "";
                    var avatar = new ArraySegment<byte>(_avatar);
                    await socket.SendAsync(avatar, WebSocketMessageType.Text, true, _stop.Token);
                    await ReceiveAsync(socket);
                }
            }
            catch (OperationCanceledException) when (_stop.IsCancellationRequested) { return; }
            catch (Exception error) { ConnectionError = error.GetBaseException().Message; }
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

    // {"type":"avatar","set":"arkit","targets":[[0,3],[0,17], ...]}
    void ReadText(string text)
    {
        if (text.StartsWith("{\"type\":\"avatar\"", StringComparison.Ordinal))
            Targets = Target.Matches(text).Cast<Match>().Select(match => match.Groups)
                .Select(groups => new[] { int.Parse(groups[1].Value), int.Parse(groups[2].Value) }).ToArray();
        else if (text.StartsWith("{\"type\":\"error\"", StringComparison.Ordinal) && Targets.Length == 0)
            Error = Regex.Unescape(ErrorText.Match(text).Groups[1].Value);
    }

    static string Quote(string text) => "\"" + text.Replace("\\", "\\\\").Replace("\"", "\\\"") + "\"";

    void ReadBinary(byte[] message)
    {
        if (message.Length < HeaderBytes || message[0] != WeightsOfFrame && message[0] != WeightsAtRest) return;
        var weights = new float[(message.Length - HeaderBytes) / sizeof(float)];
        Buffer.BlockCopy(message, HeaderBytes, weights, 0, weights.Length * sizeof(float));
        Weights = weights;
    }
}
