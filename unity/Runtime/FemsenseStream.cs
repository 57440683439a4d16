// Reads the WebSocket of `femsense stream` in the background and keeps the newest payload of each topic.
#if UNITY_5_3_OR_NEWER
using System;
using System.Collections.Concurrent;
using System.Collections.Generic;
using System.Net.WebSockets;
using System.Text;
using System.Threading;
using System.Threading.Tasks;
using UnityEngine;

namespace Femsense
{
    public sealed class FemsenseStream : MonoBehaviour
    {
        [Tooltip("ws://HOST:PORT/ws or wss://HOST:PORT/ws")] public string url = "ws://127.0.0.1:8010/ws";
        public string password = "";
        private readonly ConcurrentDictionary<string, byte[]> newest = new ConcurrentDictionary<string, byte[]>();
        private readonly ConcurrentDictionary<string, bool> robots = new ConcurrentDictionary<string, bool>();
        private readonly ConcurrentQueue<byte[]> outgoing = new ConcurrentQueue<byte[]>();
        private static readonly byte[] Confirmed = new byte[0];
        private CancellationTokenSource stop;

        /// <summary>What a server with a password is asked with.</summary>
        public string Authorization { get { return "Basic " + Convert.ToBase64String(Encoding.UTF8.GetBytes("unity:" + password)); } }

        /// <summary>The robots that were announced.</summary>
        public ICollection<string> Robots { get { return robots.Keys; } }

        /// <summary>Takes the newest payload of a topic, or null where nothing came since the last time.</summary>
        public byte[] Take(string topic)
        {
            byte[] payload;
            return newest.TryRemove(topic, out payload) ? payload : null;
        }

        /// <summary>Puts a payload there; for clients of MQTT that call this from their own thread.</summary>
        public void Receive(string topic, byte[] payload)
        {
            newest[topic] = payload;
            var parts = topic.Split('/');
            if (parts.Length == 3 && parts[0] == "femsense" && parts[2] == "model") robots[parts[1]] = true;
        }

        /// <summary>Sends a payload to a topic with the next frame that arrives: these are drag, measured and stop.</summary>
        public void Send(string topic, byte[] payload)
        {
            outgoing.Enqueue(Frames.Write(topic, payload));
        }

        /// <summary>Ends all motion of a robot, whoever steers it.</summary>
        public void Stop(string robot)
        {
            Send("femsense/" + robot + "/stop", Encoding.UTF8.GetBytes("{}"));
        }

        private void OnEnable()
        {
            stop = new CancellationTokenSource();
            var token = stop.Token;
            Task.Run(() => Run(token));
        }

        private void OnDisable()
        {
            stop.Cancel();
        }

        private async Task Run(CancellationToken token)
        {
            var buffer = new byte[1 << 20];
            while (!token.IsCancellationRequested)
            {
                try
                {
                    using (var socket = new ClientWebSocket())
                    {
                        if (password.Length > 0)
                            socket.Options.SetRequestHeader("Authorization", Authorization);
                        await socket.ConnectAsync(new Uri(url), token);
                        await Listen(socket, buffer, token);
                    }
                }
                catch (Exception error) when (!(error is OperationCanceledException))
                {
                    Debug.Log("femsense: " + error.Message + ", trying again");
                }
                await Task.Delay(1000, CancellationToken.None);
            }
        }

        private async Task Listen(ClientWebSocket socket, byte[] buffer, CancellationToken token)
        {
            int length = 0;
            while (socket.State == WebSocketState.Open)
            {
                var got = await socket.ReceiveAsync(new ArraySegment<byte>(buffer, length, buffer.Length - length), token);
                if (got.MessageType == WebSocketMessageType.Close) return;
                length += got.Count;
                if (!got.EndOfMessage && length < buffer.Length) continue;
                if (got.EndOfMessage)
                    foreach (var message in Frames.Read(buffer, length)) Receive(message.Topic, message.Payload);
                length = 0;
                byte[] wanted;
                while (outgoing.TryDequeue(out wanted))
                    await socket.SendAsync(new ArraySegment<byte>(wanted), WebSocketMessageType.Binary, true, token);
                // an empty frame: what came was taken, and the newest may follow
                await socket.SendAsync(new ArraySegment<byte>(Confirmed), WebSocketMessageType.Binary, true, token);
            }
        }
    }
}
#endif
