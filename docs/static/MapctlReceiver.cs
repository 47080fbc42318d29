// Poses a Humanoid of Unity by the stream of `mapctl live` or `mapctl steer --realtime` (docs/guides/engines.md).

using System;
using System.Collections.Generic;
using System.Net;
using System.Net.Sockets;
using System.Text;
using UnityEngine;

[RequireComponent(typeof(Animator))]
public class MapctlReceiver : MonoBehaviour
{
    public int port = 39539;
    /// <summary>Whether the left and the right toe stand.</summary>
    public bool leftPlanted, rightPlanted;
    /// <summary>Velocity of the hips over the ground, m/s, in Unity's axes.</summary>
    public Vector3 rootVelocity;

    /// <summary>Streamed bones and the parent of each, parents first.</summary>
    static readonly string[,] Parents =
    {
        { "Hips", "" },
        { "Spine", "Hips" },
        { "Chest", "Spine" },
        { "Neck", "Chest" },
        { "Head", "Neck" },
        { "LeftShoulder", "Chest" },
        { "LeftUpperArm", "LeftShoulder" },
        { "LeftLowerArm", "LeftUpperArm" },
        { "LeftHand", "LeftLowerArm" },
        { "RightShoulder", "Chest" },
        { "RightUpperArm", "RightShoulder" },
        { "RightLowerArm", "RightUpperArm" },
        { "RightHand", "RightLowerArm" },
        { "LeftUpperLeg", "Hips" },
        { "LeftLowerLeg", "LeftUpperLeg" },
        { "LeftFoot", "LeftLowerLeg" },
        { "LeftToes", "LeftFoot" },
        { "RightUpperLeg", "Hips" },
        { "RightLowerLeg", "RightUpperLeg" },
        { "RightFoot", "RightLowerLeg" },
        { "RightToes", "RightFoot" },
    };

    struct Bone
    {
        public Vector3 position;
        public Quaternion rotation;
    }

    readonly Dictionary<string, Bone> arriving = new Dictionary<string, Bone>(); // the root is ""
    readonly Dictionary<string, Bone> pose = new Dictionary<string, Bone>(); // the last whole frame
    readonly Dictionary<string, Transform> bones = new Dictionary<string, Transform>();
    readonly Dictionary<string, Quaternion> rest = new Dictionary<string, Quaternion>(); // T-pose, in the character's space
    float frame = -1; // time of the frame that arrives, which opens each of its packets
    float legLength;
    UdpClient socket;

    void Start()
    {
        var animator = GetComponent<Animator>();
        var local = new Dictionary<string, Quaternion>();
        foreach (var bone in animator.avatar.humanDescription.skeleton)
            local[bone.name] = bone.rotation;
        for (int k = 0; k < Parents.GetLength(0); k++)
        {
            string name = Parents[k, 0];
            var bone = animator.GetBoneTransform((HumanBodyBones)Enum.Parse(typeof(HumanBodyBones), name));
            if (bone == null)
                continue; // its turn goes to the bones below
            bones[name] = bone;
            rest[name] = Quaternion.identity;
            for (var at = bone; at != transform; at = at.parent)
                rest[name] = (local.TryGetValue(at.name, out var turn) ? turn : at.localRotation) * rest[name];
        }
        legLength = Vector3.Distance(bones["LeftUpperLeg"].position, bones["LeftLowerLeg"].position)
            + Vector3.Distance(bones["LeftLowerLeg"].position, bones["LeftFoot"].position);
        socket = new UdpClient(port);
    }

    void OnDestroy()
    {
        if (socket != null)
            socket.Close();
    }

    void Update()
    {
        var sender = new IPEndPoint(IPAddress.Any, 0);
        while (socket.Available > 0)
        {
            byte[] packet = socket.Receive(ref sender);
            if (packet.Length == 0)
                continue;
            try
            {
                ReadPacket(packet, 0, packet.Length);
            }
            catch (ArgumentException)
            {
                // other programs' packets, which are no OSC
            }
        }
    }

    void LateUpdate() // after the Animator
    {
        if (pose.Count == 0)
            return;
        if (pose.TryGetValue("", out var root))
        {
            transform.localPosition = root.position;
            transform.localRotation = root.rotation;
        }
        float scale = legLength / (pose["LeftLowerLeg"].position.magnitude + pose["LeftFoot"].position.magnitude);
        var turned = new Dictionary<string, Quaternion> { { "", Quaternion.identity } }; // from the T-pose
        for (int k = 0; k < Parents.GetLength(0); k++)
        {
            string name = Parents[k, 0];
            turned[name] = turned[Parents[k, 1]] * pose[name].rotation;
            if (bones.TryGetValue(name, out var bone))
                bone.rotation = transform.rotation * turned[name] * rest[name];
        }
        // The length of a leg in the world has the scale of the character in it.
        bones["Hips"].position = transform.position + transform.rotation * (pose["Hips"].position * scale);
    }

    /// <summary>Reads an OSC packet: a message, or a bundle of them.</summary>
    void ReadPacket(byte[] data, int at, int end)
    {
        if (data[at] != '#')
        {
            ReadMessage(data, at, end);
            return;
        }
        for (at += 16; at + 4 <= end;) // after the name and the time of the bundle
        {
            int size = ReadInt(data, at);
            if (size <= 0 || size > end - at - 4)
                return;
            ReadPacket(data, at + 4, at + 4 + size);
            at += 4 + size;
        }
    }

    void ReadMessage(byte[] data, int at, int end)
    {
        string address = ReadText(data, ref at, end), tags = ReadText(data, ref at, end), name = "";
        var values = new List<float>();
        foreach (char tag in tags.Substring(Math.Min(1, tags.Length)))
        {
            if (tag == 's')
            {
                name = ReadText(data, ref at, end);
                continue;
            }
            if ((tag != 'f' && tag != 'i') || at + 4 > end)
                return;
            int bits = ReadInt(data, at);
            values.Add(tag == 'i' ? bits : BitConverter.ToSingle(BitConverter.GetBytes(bits), 0));
            at += 4;
        }
        Take(address, tags, name, values);
    }

    void Take(string address, string tags, string name, List<float> values)
    {
        switch (address + tags)
        {
            case "/mapctl/frame,f":
                if (values[0] != frame) // bones of a frame that has lost a packet are left out
                    arriving.Clear();
                frame = values[0];
                break;
            case "/VMC/Ext/Root/Pos,sfffffff":
                arriving[""] = ReadBone(values);
                break;
            case "/VMC/Ext/Bone/Pos,sfffffff":
                arriving[name] = ReadBone(values);
                break;
            case "/mapctl/contacts,ff":
                leftPlanted = values[0] > 0.5f;
                rightPlanted = values[1] > 0.5f;
                break;
            case "/mapctl/root_velocity,ff": // in mapctl's axes, whose x is the other way round
                rootVelocity = new Vector3(-values[0], 0, values[1]);
                break;
            case "/VMC/Ext/T,f":
                bool whole = true;
                for (int k = 0; k < Parents.GetLength(0); k++)
                    whole &= arriving.ContainsKey(Parents[k, 0]);
                if (whole)
                    foreach (var bone in arriving)
                        pose[bone.Key] = bone.Value;
                arriving.Clear();
                break;
        }
    }

    static Bone ReadBone(List<float> v) // the protocol's axes are Unity's
    {
        return new Bone { position = new Vector3(v[0], v[1], v[2]), rotation = new Quaternion(v[3], v[4], v[5], v[6]) };
    }

    static int ReadInt(byte[] data, int at)
    {
        return IPAddress.NetworkToHostOrder(BitConverter.ToInt32(data, at));
    }

    /// <summary>Reads a text, which ends with a zero and fills words of four bytes.</summary>
    static string ReadText(byte[] data, ref int at, int end)
    {
        int stop = at < end ? Array.IndexOf(data, (byte)0, at, end - at) : -1;
        if (stop < 0)
            throw new ArgumentException("a text without end");
        string text = Encoding.ASCII.GetString(data, at, stop - at);
        at += (text.Length / 4 + 1) * 4;
        return text;
    }
}
