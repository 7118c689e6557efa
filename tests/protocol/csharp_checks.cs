// Answers questions of test_csharp_unity.py: a line of stdin is a function's name and its numbers or words, a line of
// stdout the numbers of the result.

using System;
using System.Collections.Generic;
using System.Globalization;
using TubeCosim;

public static class Checks
{
    public static void Main()
    {
        for (string line = Console.ReadLine(); line != null; line = Console.ReadLine())
        {
            string[] words = line.Split(' ');
            try
            {
                Print(Answer(words[0], words));
            }
            catch (Refusal refusal)
            {
                Console.WriteLine("refused " + refusal.Field);
            }
        }
    }

    private static double[] Answer(string function, string[] words)
    {
        if (function == "mesh")
            return Mesh(words);
        if (function == "alive")
            return new[] { Liveness.IsDead(long.Parse(words[1]), long.Parse(words[2])) ? 0.0 : 1.0 };
        if (function == "splitmix")
            return Halves(ForceLaw.SplitMix64(ulong.Parse(words[1])));
        if (function == "gust")
            return Flat(ForceLaw.Gust((ulong)long.Parse(words[1]), long.Parse(words[2]), Number(words[3])));
        double[] n = new double[words.Length - 1];
        for (int i = 0; i < n.Length; i++)
            n[i] = Number(words[i + 1]);
        switch (function)
        {
            case "vector":
                return Flat(Frames.Vector(new Vector3d(n[0], n[1], n[2])));
            case "spin":
                return Flat(Frames.Spin(new Vector3d(n[0], n[1], n[2])));
            case "rotation":
                Quaterniond q = Frames.Rotation(new Quaterniond(n[0], n[1], n[2], n[3]));
                return new[] { q.X, q.Y, q.Z, q.W };
            case "rotate":
                return Flat(new Quaterniond(n[0], n[1], n[2], n[3]).Rotate(new Vector3d(n[4], n[5], n[6])));
            case "law":
                return Law(n);
            default:
                throw new ArgumentException(function);
        }
    }

    // Numbers: quaternion, velocities, command, gust, 18 parameters. Result: force, torque, gyroscopic torque.
    private static double[] Law(double[] n)
    {
        LanePose pose = new LanePose
        {
            Rotation = new Quaterniond(n[0], n[1], n[2], n[3]),
            LinearVelocity = new Vector3d(n[4], n[5], n[6]),
            AngularVelocity = new Vector3d(n[7], n[8], n[9]),
        };
        LaneCommand command = new LaneCommand
        {
            Direction = new Vector3d(n[10], n[11], n[12]),
            Speed = n[13],
            Compensation = n[14],
        };
        double[] parameters = new double[Layout.ParameterSlots];
        Array.Copy(n, 18, parameters, 0, Layout.Parameters.Length);
        List<double> all = new List<double>();
        all.AddRange(Flat(ForceLaw.Force(pose, command, parameters, new Vector3d(n[15], n[16], n[17]))));
        all.AddRange(Flat(ForceLaw.Torque(pose, command, parameters)));
        all.AddRange(Flat(ForceLaw.Gyroscopic(pose, parameters)));
        return all.ToArray();
    }

    // Words: axes, scale, hash, path (without blanks). Result: the corners of all triangles.
    private static double[] Mesh(string[] words)
    {
        byte[] sha256 = new byte[32];
        for (int i = 0; i < sha256.Length; i++)
            sha256[i] = byte.Parse(words[3].Substring(2 * i, 2), NumberStyles.HexNumber);
        WallMesh wall = WallMesh.Read(new TubeReference
        {
            YUp = words[1] == "yup",
            Scale = Number(words[2]),
            Sha256 = sha256,
            Path = words[4],
        });
        List<double> corners = new List<double>();
        foreach (int corner in wall.Triangles)
            corners.AddRange(Flat(wall.Vertices[corner]));
        return corners.ToArray();
    }

    private static double[] Halves(ulong value)
    {
        return new double[] { value >> 32, value & 0xFFFFFFFF };
    }

    private static double[] Flat(Vector3d v)
    {
        return new[] { v.X, v.Y, v.Z };
    }

    private static double Number(string word)
    {
        return double.Parse(word, CultureInfo.InvariantCulture);
    }

    private static void Print(double[] numbers)
    {
        Console.WriteLine(string.Join(" ", Array.ConvertAll(numbers, Format.Of)));
    }
}
