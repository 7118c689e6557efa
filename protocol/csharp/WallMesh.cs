// The wall of a registered tube: reads a Wavefront .obj file, checks its hash, scales it and turns Z up.

using System;
using System.Collections.Generic;
using System.Globalization;
using System.IO;
using System.Security.Cryptography;

namespace TubeCosim
{
    public sealed class WallMesh
    {
        public Vector3d[] Vertices; // metres, the protocol's frame
        public int[] Triangles; // three indices into Vertices each

        private static readonly char[] Blanks = { ' ', '\t' };

        // Throws Refusal where there is no such file, it hashes to another value, or it cannot be read.
        public static WallMesh Read(TubeReference tube)
        {
            if (!tube.Path.EndsWith(".obj", StringComparison.OrdinalIgnoreCase))
                throw new Refusal("tube_path", "a Wavefront file, .obj", tube.Path);
            byte[] bytes;
            try
            {
                bytes = File.ReadAllBytes(tube.Path);
            }
            catch (Exception error) when (error is IOException || error is UnauthorizedAccessException
                || error is ArgumentException || error is NotSupportedException)
            {
                throw new Refusal("tube_path", "a file that can be read", tube.Path + ": " + error.Message);
            }
            using (SHA256 hash = SHA256.Create())
            {
                string expected = BitConverter.ToString(tube.Sha256), found = BitConverter.ToString(hash.ComputeHash(bytes));
                if (found != expected)
                    throw new Refusal("tube_sha256", expected, found + " of " + tube.Path);
            }
            return Parse(bytes, tube);
        }

        private static WallMesh Parse(byte[] bytes, TubeReference tube)
        {
            List<Vector3d> vertices = new List<Vector3d>();
            List<int> triangles = new List<int>();
            int number = 0;
            try
            {
                using (StreamReader reader = new StreamReader(new MemoryStream(bytes)))
                    for (string line = reader.ReadLine(); line != null; line = reader.ReadLine())
                    {
                        number++;
                        while (line.EndsWith("\\", StringComparison.Ordinal)) // goes on in the next line
                            line = line.Substring(0, line.Length - 1) + reader.ReadLine();
                        string[] words = line.Split(Blanks, StringSplitOptions.RemoveEmptyEntries);
                        if (words.Length > 0 && words[0] == "v")
                            vertices.Add(Vertex(words, tube));
                        else if (words.Length > 0 && words[0] == "f")
                            AddFan(words, vertices.Count, triangles);
                    }
            }
            catch (Exception error) when (error is FormatException || error is IndexOutOfRangeException
                || error is OverflowException)
            {
                throw new Refusal("tube_path", "a Wavefront file",
                    tube.Path + ", line " + Format.Of(number) + ": " + error.Message);
            }
            if (triangles.Count == 0)
                throw new Refusal("tube_path", "a mesh with faces", tube.Path + " without any");
            return new WallMesh { Vertices = vertices.ToArray(), Triangles = triangles.ToArray() };
        }

        private static Vector3d Vertex(string[] words, TubeReference tube)
        {
            double x = tube.Scale * Number(words[1]), y = tube.Scale * Number(words[2]);
            double z = tube.Scale * Number(words[3]);
            return tube.YUp ? new Vector3d(x, -z, y) : new Vector3d(x, y, z);
        }

        private static double Number(string word)
        {
            double value = double.Parse(word, NumberStyles.Float, CultureInfo.InvariantCulture);
            if (!Validation.IsFinite(value))
                throw new FormatException("a coordinate that is not finite: " + word);
            return value;
        }

        // A polygon is a fan of triangles from its first corner.
        private static void AddFan(string[] words, int vertices, List<int> triangles)
        {
            int first = Corner(words[1], vertices), last = Corner(words[2], vertices);
            for (int i = 3; i < words.Length; i++)
            {
                int next = Corner(words[i], vertices);
                triangles.Add(first);
                triangles.Add(last);
                triangles.Add(next);
                last = next;
            }
        }

        // Corners are vertex, vertex/texture or vertex/texture/normal; they count from 1, or from the end if negative.
        private static int Corner(string word, int vertices)
        {
            int index = int.Parse(word.Split('/')[0], NumberStyles.AllowLeadingSign, CultureInfo.InvariantCulture);
            int corner = index > 0 ? index - 1 : vertices + index;
            if (index == 0 || corner < 0 || corner >= vertices)
                throw new FormatException("no vertex " + word + " among " + Format.Of(vertices));
            return corner;
        }
    }
}
