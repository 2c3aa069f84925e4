// Moves 21 balls in Unity as the hand moves: put this on an empty GameObject, press Play, and start
// python track.py device=realsense stream=udp stream.fields=[index,lost,joints_m]
using System.Globalization;
using System.Net;
using System.Net.Sockets;
using System.Text;
using System.Text.RegularExpressions;
using UnityEngine;

public class HandReceiver : MonoBehaviour {
    static readonly Regex Joint = new Regex(@"\[(-?\d[^,\]]*),(-?\d[^,\]]*),(-?\d[^,\]]*)\]");
    readonly Transform[] joints = new Transform[21]; // 0 the wrist, 8 the index finger's tip
    UdpClient receiver; // opened in Start: Unity's editor constructs components that never play, too

    void Start() {
        receiver = new UdpClient(new IPEndPoint(IPAddress.Loopback, 5005));
        for (int i = 0; i < joints.Length; i++) {
            joints[i] = GameObject.CreatePrimitive(PrimitiveType.Sphere).transform;
            joints[i].SetParent(transform, false);
            joints[i].localScale = 0.012f * Vector3.one;
        }
    }

    void Update() {
        string line = null;
        var sender = new IPEndPoint(IPAddress.Any, 0);
        while (receiver.Available > 0) line = Encoding.UTF8.GetString(receiver.Receive(ref sender));
        if (line == null || line.Contains("\"lost\":true")) return;
        var found = Joint.Matches(line, line.IndexOf("\"joints_m\":"));
        for (int i = 0; i < joints.Length; i++) // metres; the camera's y is down, and Unity's up
            joints[i].localPosition = new Vector3(At(found[i], 1), -At(found[i], 2), At(found[i], 3));
    }

    static float At(Match match, int part) => float.Parse(match.Groups[part].Value, CultureInfo.InvariantCulture);

    void OnDestroy() => receiver?.Close();
}
